"""The meshes from which masses and inertias of bodies of an MJCF are computed.

A mesh is opened only where a body has no other weight.  Its file is read here, under a limit, and
the library computes its mass properties in a separate model, so that a missing or broken mesh is a
fault only of those bodies that need it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from iblf_jax.core import checks
from iblf_jax.core.attributes import attributes
from iblf_jax.world.robots.description import Shown, contents

if TYPE_CHECKING:
    import mujoco

LARGEST_MESHES = 512 << 20
"""Largest total size of the meshes of a model [bytes]."""
OF_MESH = (
    "name",
    "file",
    "content_type",
    "scale",
    "refpos",
    "refquat",
    "inertia",
    "maxhullvert",
    "uservert",
    "userface",
)
OF_GEOM = ("type", "meshname", "typeinertia", "fitscale")
"""What decides whether the library can weigh a geom that has its shape from a mesh."""
REMEDY = "Or give the body an <inertial>."


class Meshes:
    """The meshes of a specification, each of which is opened when a geom needs it; `leave` removes
    the others.
    """

    def __init__(self, spec: mujoco.MjSpec, folder: Path, bare: bool) -> None:
        """`spec` is the library's, parsed; the files lie in `folder`, under their bare names if
        `bare`.
        """
        self.spec, self.folder, self.bare = spec, folder, bare
        self.meshes = {mesh.name: mesh for mesh in spec.meshes}
        self.opened: dict[str, Path | None] = {}
        """Mesh -> its file, if it has one."""
        self.files: dict[str, bytes] = {}
        """Name of a file for the library -> its content."""
        self.problems: dict[str, ValueError | None] = {}

    def problem(self, geom: mujoco.MjsGeom) -> ValueError | None:
        """Why a geom with a mesh cannot be weighed; None if it can, and then the mesh stays."""
        shape = repr(list(attributes(geom, OF_GEOM).values()))
        if shape not in self.problems:
            try:
                self._weigh(geom)
                self.problems[shape] = None
            except ValueError as error:
                self.problems[shape] = error
        geom.contype = geom.conaffinity = (
            0  # it collides with nothing here: no hull of it is needed
        )
        return self.problems[shape]

    def leave(self) -> None:
        """Removes the meshes that no geom needed from the specification, and gives it the files of
        the others.
        """
        for name, mesh in self.meshes.items():
            if name not in self.opened:
                self.spec.delete(mesh)
        self.spec.assets = self.files

    def _weigh(self, geom: mujoco.MjsGeom) -> None:
        """Raises unless the library can weigh the geom."""
        if geom.hfieldname or geom.meshname not in self.meshes:
            got = geom.meshname
            if geom.hfieldname:
                got = Shown(f"height field {geom.hfieldname!r}")
            raise checks.fail(
                "its weight",
                got,
                "masses and inertias in numbers, or the name of a <mesh>",
                "Give the body an <inertial>.",
            )
        mesh = self.meshes[geom.meshname]
        if geom.meshname not in self.opened:
            self.opened[geom.meshname] = self._open(mesh)
        separate = type(self.spec)()
        copy, shaped = separate.add_mesh(), separate.worldbody.add_body().add_geom()
        for one, other, names in ((copy, mesh, OF_MESH), (shaped, geom, OF_GEOM)):
            for name, value in attributes(other, names).items():
                setattr(one, name, value)
        shaped.contype = shaped.conaffinity = 0
        separate.assets = {name: data for name, data in self.files.items() if name == mesh.file}
        try:
            separate.compile()
        except ValueError as error:
            path = self.opened.pop(geom.meshname)
            got = Shown(path or "vertices in the model")
            reason = " ".join(str(error).split())
            raise checks.fail(
                f"mesh {mesh.name!r}", got, "a surface around a volume", f"{reason}. {REMEDY}"
            ) from None

    def _open(self, mesh: mujoco.MjsMesh) -> Path | None:
        """Reads the file of a mesh, if it has one."""
        if not mesh.file:
            return None
        field = f"mesh {mesh.name!r}"
        file = mesh.file
        if self.bare:
            file = Path(file).name
        path = self.folder / file
        left = LARGEST_MESHES - sum(map(len, self.files.values()))
        data = contents(field, path, left, "the path of a mesh, STL, OBJ or MSH", REMEDY)
        if len(data) > left:
            raise checks.fail(
                field, str(path), f"meshes of at most {LARGEST_MESHES >> 20} MiB together", REMEDY
            )
        mesh.file = f"{len(self.files)}{path.suffix}"
        self.files[mesh.file] = data
        return path
