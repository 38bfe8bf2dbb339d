"""Elements of a URDF file as text, in SI units."""

from __future__ import annotations

from pathlib import Path

Vec3 = tuple[float, float, float]


def xyz(*values: float) -> str:
    """Return numbers as the text of an attribute."""
    return " ".join(f"{value:.9g}" for value in values)


def inertial(mass_kg: float, com_m: Vec3, diagonal: Vec3) -> str:
    """Return a link's mass, centre of mass, and diagonal of the inertia tensor about it, kg.m^2."""
    ixx, iyy, izz = diagonal
    return (
        f'<inertial><origin xyz="{xyz(*com_m)}"/><mass value="{mass_kg:g}"/>'
        f'<inertia ixx="{ixx:.6g}" ixy="0" ixz="0" iyy="{iyy:.6g}" iyz="0" izz="{izz:.6g}"/></inertial>'
    )


def shape(tag: str, geometry: str, xyz_m: tuple[float, ...], rpy: tuple[float, ...] = (0, 0, 0), rgba: str = "") -> str:
    """Return a shape of a link; `tag`: "visual", which has a colour `rgba`, or "collision"."""
    material = f'<material name="c{rgba.replace(" ", "_")}"><color rgba="{rgba}"/></material>' if rgba else ""
    return f'<{tag}><origin xyz="{xyz(*xyz_m)}" rpy="{xyz(*rpy)}"/><geometry>{geometry}</geometry>{material}</{tag}>'


def box(x_m: float, y_m: float, z_m: float) -> str:
    """Return the geometry of a box."""
    return f'<box size="{xyz(x_m, y_m, z_m)}"/>'


def cylinder(radius_m: float, length_m: float) -> str:
    """Return the geometry of a cylinder along z."""
    return f'<cylinder radius="{radius_m:g}" length="{length_m:g}"/>'


def write_urdf(name: str, parts: str, folder: Path) -> Path:
    """Write the links and joints of a robot to `folder`/`name`.urdf (PyBullet only loads files); return the path."""
    # PyBullet reads lines of at most 8 KiB and breaks longer ones anywhere, inside a word too.
    text = f'<?xml version="1.0"?><robot name="{name}">{parts}</robot>'.replace("><", ">\n<") + "\n"
    path = folder / f"{name}.urdf"
    path.write_text(text, encoding="utf-8")
    return path
