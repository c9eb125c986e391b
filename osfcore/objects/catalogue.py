"""The catalogue of YCB objects: label, mass, symmetry, licence. Meshes come from `sources`.

Masses are those of the YCB data sheet. Symmetries follow BOP's YCB-V in the object frame (the google_16k axes, origin
at the bounding box's centre): an object is symmetric only where its label and colours are, too. The axes of the
symmetric objects were measured on the meshes: they lie within a degree of the frame's.
"""

from collections.abc import Mapping
from types import MappingProxyType

from osfcore.objects.asset import ObjectInfo, Symmetry

LICENCE = "CC-BY-4.0"
ATTRIBUTION = "YCB Object and Model Set, ycbbenchmarks.com (Calli et al. 2015)"

_S = 0.5**0.5
_SQUARE_PRISM = (
    (_S, 0.0, 0.0, _S),  # turns about z
    (0.0, 0.0, 0.0, 1.0),
    (_S, 0.0, 0.0, -_S),
    (0.0, 1.0, 0.0, 0.0),  # half turns about horizontal axes
    (0.0, 0.0, 1.0, 0.0),
    (0.0, _S, _S, 0.0),
    (0.0, _S, -_S, 0.0),
)
_HALF_TURN_Z = ((0.0, 0.0, 0.0, 1.0),)
_LABEL = "printed label breaks the symmetry"
_BRICK = "plain brick, holes in its top only"

_ROWS = (
    ("002_master_chef_can", "Master Chef can", 0.414, Symmetry("none", reason=_LABEL)),
    ("003_cracker_box", "Cracker box", 0.411, Symmetry("none", reason=_LABEL)),
    ("004_sugar_box", "Sugar box", 0.514, Symmetry("none", reason=_LABEL)),
    ("005_tomato_soup_can", "Tomato soup can", 0.349, Symmetry("none", reason=_LABEL)),
    ("006_mustard_bottle", "Mustard bottle", 0.603, Symmetry("none", reason=_LABEL)),
    ("007_tuna_fish_can", "Tuna fish can", 0.171, Symmetry("none", reason=_LABEL)),
    ("008_pudding_box", "Pudding box", 0.187, Symmetry("none", reason=_LABEL)),
    ("009_gelatin_box", "Gelatin box", 0.097, Symmetry("none", reason=_LABEL)),
    ("010_potted_meat_can", "Potted meat can", 0.370, Symmetry("none", reason=_LABEL)),
    ("011_banana", "Banana", 0.066, Symmetry("none", reason="bent, with unlike ends")),
    ("013_apple", "Apple", 0.068, Symmetry("none", reason="uneven shape and colour")),
    ("016_pear", "Pear", 0.049, Symmetry("none", reason="uneven shape and colour")),
    ("019_pitcher_base", "Pitcher base", 0.178, Symmetry("none", reason="handle and spout")),
    ("021_bleach_cleanser", "Bleach cleanser", 1.131, Symmetry("none", reason=_LABEL)),
    ("022_windex_bottle", "Windex bottle", 1.022, Symmetry("none", reason=_LABEL)),
    ("024_bowl", "Bowl", 0.147, Symmetry("continuous", axis=(0.0, 0.0, 1.0), reason="plain body of revolution")),
    ("025_mug", "Mug", 0.118, Symmetry("none", reason="handle")),
    ("035_power_drill", "Power drill", 0.895, Symmetry("none", reason="no symmetric shape")),
    ("036_wood_block", "Wood block", 0.729, Symmetry("discrete", _SQUARE_PRISM, reason="plain square block")),
    ("061_foam_brick", "Foam brick", 0.028, Symmetry("discrete", _HALF_TURN_Z, reason=_BRICK)),
)

CATALOGUE: Mapping[str, ObjectInfo] = MappingProxyType(
    {name: ObjectInfo(name, label, mass, symmetry, LICENCE, ATTRIBUTION) for name, label, mass, symmetry in _ROWS}
)

DEFAULT_NAMES: tuple[str, ...] = (*(name for name in CATALOGUE if name < "011"), "035_power_drill")
"""The objects that the package on PyPI holds: 002 to 010 and the drill."""
