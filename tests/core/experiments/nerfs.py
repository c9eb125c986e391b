"""Fields that know of no light, without training: the shipped ones, made blind."""

from pathlib import Path

from osfcore.fields.field_library import FIELD_FILE, FieldLibrary
from osfcore.fields.kiloosf import without_light, write_field
from tests.core.experiments.solids import SOLIDS


def write_nerfs(data_dir: Path) -> None:
    """Put them into DATA_DIR/nerf/fields, for three objects."""
    for name in SOLIDS:
        path = data_dir / "nerf" / "fields" / name / FIELD_FILE
        path.parent.mkdir(parents=True)
        write_field(path, without_light(FieldLibrary(None).load(name)))
