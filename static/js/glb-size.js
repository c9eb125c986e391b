// How large a GLB is in its own unit, read in the browser before anything is sent.

const MAGIC = 0x46546c67; // "glTF"
const JSON_CHUNK = 0x4e4f534a;

async function description(file) {
  const head = new DataView(await file.slice(0, 20).arrayBuffer());
  if (head.byteLength < 20 || head.getUint32(0, true) !== MAGIC || head.getUint32(16, true) !== JSON_CHUNK) return null;
  return JSON.parse(await file.slice(20, 20 + head.getUint32(12, true)).text());
}

/** The extents [file units], or null where that takes more than a look at its table of contents. */
export async function glbSize(file) {
  const gltf = await description(file).catch(() => null);
  if (!gltf?.meshes || gltf.nodes?.some((node) => node.matrix || node.scale || node.rotation || node.translation)) return null;
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const { attributes } of gltf.meshes.flatMap((mesh) => mesh.primitives)) {
    const { min, max } = gltf.accessors?.[attributes.POSITION] ?? {};
    if (!min || !max) return null;
    for (let i = 0; i < 3; i += 1) {
      low[i] = Math.min(low[i], min[i]);
      high[i] = Math.max(high[i], max[i]);
    }
  }
  const size = high.map((most, i) => most - low[i]);
  const [x, y, z] = size; // y is up in a GLB, z on the table
  return size.every(Number.isFinite) ? [x, z, y] : null;
}
