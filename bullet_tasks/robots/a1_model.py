"""A light model of the Unitree A1 as URDF text: boxes and spheres instead of meshes, the masses and joints of a1.urdf."""

from bullet_tasks.robots.gait import FOOT_RADIUS, HIP_LENGTH, HIP_X, HIP_Y, LINK_LENGTH

LEGS = (("FR", 1, -1), ("FL", 1, 1), ("RR", -1, -1), ("RL", -1, 1))
"""Name, 1 for a front leg, 1 for a left leg; in the order of ``gait``."""
JOINTS = tuple(f"{leg}_{joint}_joint" for leg, _, _ in LEGS for joint in ("hip", "upper", "lower"))
"""Names of the motors, leg after leg; the same in a1.urdf."""

_TRUNK_SIZE = (0.267, 0.194, 0.114)  # m
_SHOULDER_RADIUS = 0.046  # m; the hips' motors, which are the outermost parts of the trunk
_SHOULDER_Y = 0.081  # m
_HEAD_SIZE, _HEAD_X, _HEAD_Z = (0.11, 0.16, 0.12), 0.20, 0.02  # m, only for the eye
_UPPER_SIZE, _LOWER_SIZE = (0.034, 0.025, 0.2), (0.02, 0.02, 0.18)  # m
_EFFORT = 33.5  # N m
_COLOURS = {"trunk": "0.16 0.22 0.36 1", "head": "1 0.45 0.08 1", "leg": "0.1 0.11 0.13 1"}


def urdf() -> str:
    """The model as text for ``loadURDF``."""
    materials = "".join(f'<material name="{name}"><color rgba="{rgba}"/></material>' for name, rgba in _COLOURS.items())
    shoulders = [(fore * HIP_X, side * _SHOULDER_Y, 0.0) for _, fore, side in LEGS]
    trunk = (
        _inertial(
            (0.012731, 0.002186, 0.000515), 4.713, (0.01683993, 8.3902e-05, 0.000597679, 0.056579028, 2.5134e-05, 0.064713601)
        )
        + _part("visual", _box(_TRUNK_SIZE), (0.0, 0.0, 0.0), "trunk")
        + _part("visual", _box(_HEAD_SIZE), (_HEAD_X, 0.0, _HEAD_Z), "head")
        + _part("collision", _box(_TRUNK_SIZE), (0.0, 0.0, 0.0))
    )
    for shoulder in shoulders:
        trunk += _part("visual", _sphere(_SHOULDER_RADIUS), shoulder, "leg")
        trunk += _part("collision", _sphere(_SHOULDER_RADIUS), shoulder)
    legs = "".join(_leg(name, fore, side) for name, fore, side in LEGS)
    return f'<?xml version="1.0"?><robot name="a1_light">{materials}<link name="trunk">{trunk}</link>{legs}</robot>'


def _leg(name: str, fore: int, side: int) -> str:
    hip = _inertial(
        (-0.003311 * fore, 0.000635 * side, 3.1e-05),
        0.696,
        (0.000469246, -9.409e-06 * fore * side, -3.42e-07 * fore, 0.00080749, -4.66e-07 * side, 0.000552929),
    )
    upper = _inertial(
        (-0.003237, -0.022327 * side, -0.027326),
        1.013,
        (0.005529065, 4.825e-06 * side, 0.000343869, 0.005139339, 2.2448e-05 * side, 0.001367788),
    ) + _part("visual", _box(_UPPER_SIZE), (0.0, 0.0, -0.5 * LINK_LENGTH), "leg")
    # With the foot's mass of 0.06 kg.
    lower = _inertial((0.004728, 0.0, -0.131975), 0.226, (0.003397997, 0.0, -0.000140652, 0.003414943, 0.0, 3.5308e-05))
    shin, foot = (0.0, 0.0, -0.5 * _LOWER_SIZE[2]), (0.0, 0.0, -LINK_LENGTH)
    for kind, material in (("visual", "leg"), ("collision", "")):
        lower += _part(kind, _box(_LOWER_SIZE), shin, material) + _part(kind, _sphere(FOOT_RADIUS), foot, material)
    return (
        _joint(f"{name}_hip", "trunk", (fore * HIP_X, side * HIP_Y, 0.0), "1 0 0", (-0.802851, 0.802851), 52.4)
        + f'<link name="{name}_hip">{hip}</link>'
        + _joint(f"{name}_upper", f"{name}_hip", (0.0, side * HIP_LENGTH, 0.0), "0 1 0", (-1.047198, 4.18879), 28.6)
        + f'<link name="{name}_upper">{upper}</link>'
        + _joint(f"{name}_lower", f"{name}_upper", (0.0, 0.0, -LINK_LENGTH), "0 1 0", (-2.696534, -0.916298), 28.6)
        + f'<link name="{name}_lower">{lower}</link>'
    )


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _box(size: tuple[float, float, float]) -> str:
    return f'<box size="{_numbers(size)}"/>'


def _sphere(radius: float) -> str:
    return f'<sphere radius="{radius}"/>'


def _part(kind: str, geometry: str, place: tuple[float, float, float], material: str = "") -> str:
    colour = f'<material name="{material}"/>' if material else ""
    return f'<{kind}><origin xyz="{_numbers(place)}"/><geometry>{geometry}</geometry>{colour}</{kind}>'


def _inertial(centre: tuple[float, float, float], mass: float, inertia: tuple[float, ...]) -> str:
    moments = " ".join(
        f'{name}="{x:.9g}"' for name, x in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), inertia, strict=True)
    )
    return f'<inertial><origin xyz="{_numbers(centre)}"/><mass value="{mass}"/><inertia {moments}/></inertial>'


def _joint(
    child: str, parent: str, place: tuple[float, float, float], axis: str, limits: tuple[float, float], speed: float
) -> str:
    return (
        f'<joint name="{child}_joint" type="revolute"><origin xyz="{_numbers(place)}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>'
        f'<limit effort="{_EFFORT}" velocity="{speed}" lower="{limits[0]}" upper="{limits[1]}"/></joint>'
    )
