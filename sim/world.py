"""The PyBullet world: one client, walls to bump into, or painted faces to look at."""

import atexit
import contextlib
import ctypes
import io
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from mapfusion.errors import DamagedFileError
from mapfusion.files import name_in_text, require_file, write_whole
from mapfusion.geometry.numerics import Float
from sim.floorplan import Face, FloorPlan
from sim.renderer import BulletRenderer, egl_driver, load_egl
from sim.textures import DEFAULT_TEXTURE, Texture, paint, paint_posters

GRAVITY_M_S2 = 9.81
PHYSICS_HZ = 240  # PyBullet's own default; contacts and motors are tuned for it
CORNERS = "corners.npy"  # of all faces, beside their meshes and textures
# Each process that draws reads all pictures, and takes ten times as long for compressed ones; the
# room they take is small beside that of the features found in them.
PICTURE = ".bmp"
OUT_OF_SIGHT_M = -100.0  # below the floor, where what must not be seen waits

GL_ROW_TEXELS = 4  # OpenGL's default row alignment
# Who collides with whom (bit masks): wheels with the ground alone.
GROUND, WHEEL, BODY = 1, 2, 4


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Keep what C code prints off the user's screen: stdout and stderr lead nowhere meanwhile.

    PyBullet writes with C's printf, past `sys.stdout`, so the file descriptors are redirected.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    saved = {fd: os.dup(fd) for fd in (1, 2) if _is_open(fd)}
    try:
        for fd in saved:
            os.dup2(nowhere, fd)
        yield
    finally:
        libc.fflush(None)  # what C still buffers must not reach the screen later
        for fd, copy in saved.items():
            os.dup2(copy, fd)
            os.close(copy)
        os.close(nowhere)


def _is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


class World:
    """Owns a PyBullet client without a screen; use it in a `with` block.

    Args:
        renderer: what draws; raises InputError where it cannot.

    Attributes:
        renderer: what draws.
        bullet: the `pybullet` module.
        client: id to pass as `physicsClientId`.
    """

    def __init__(self, renderer: BulletRenderer = "tiny") -> None:
        if renderer == "egl":
            egl_driver()  # raises where there is none
        self.renderer = renderer
        with silence():
            import pybullet

            self.bullet = pybullet
            self.client = pybullet.connect(pybullet.DIRECT)
            if renderer == "egl":
                load_egl(pybullet, self.client)
                atexit.register(self.close)  # a world left open would take its leave on stdout
        self._faces: list[int] = []
        self._shown = np.zeros(0, dtype=bool)
        # else a mesh written anew under an old name would still look as it did before
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self.client)

    def __enter__(self) -> "World":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self.client >= 0:
            with silence():
                self.bullet.disconnect(physicsClientId=self.client)
            self.client = -1
            atexit.unregister(self.close)

    def start_physics(self) -> int:
        """Gravity, time step and a flat ground; returns the ground's body id."""
        p, client = self.bullet, self.client
        p.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=1 / PHYSICS_HZ,
            deterministicOverlappingPairs=1,
            # PyBullet's friction cone is aligned with the world's axes: with it the track of a
            # turning robot varies fourfold with its heading, without it by a fifth
            enableConeFriction=0,
            physicsClientId=client,
        )
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        ground = p.createMultiBody(0, plane, physicsClientId=client)
        p.changeDynamics(ground, -1, lateralFriction=1.0, physicsClientId=client)
        p.setCollisionFilterGroupMask(ground, -1, GROUND, WHEEL | BODY, physicsClientId=client)
        return ground

    def step(self, n: int) -> None:
        """Let 1/240 s pass, n times."""
        for _ in range(n):
            self.bullet.stepSimulation(physicsClientId=self.client)

    def add_solid_wall(self, start: Float, end: Float, thickness_m: float, height_m: float) -> None:
        """A wall from `start` to `end` (2,), (2,) as a box to bump into."""
        p, client = self.bullet, self.client
        along = end - start
        half = [float(np.linalg.norm(along)) / 2, thickness_m / 2, height_m / 2]
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        wall = p.createMultiBody(
            0,
            shape,
            basePosition=[*((start + end) / 2), height_m / 2],
            baseOrientation=p.getQuaternionFromEuler([0, 0, np.arctan2(along[1], along[0])]),
            useMaximalCoordinates=1,  # of other bodies that stand still each pair is looked at
            physicsClientId=client,
        )
        p.setCollisionFilterGroupMask(wall, -1, BODY, BODY, physicsClientId=client)

    def add_painted_faces(self, folder: Path) -> Float:
        """Load the faces that `write_faces` left in `folder`, to be seen and not touched.

        Returns:
            Their corners (F, 4, 3).

        Raises:
            DamagedFileError: a file of the folder is missing or damaged.
        """
        p, client = self.bullet, self.client
        corners_m = read_corners(folder / CORNERS)
        with silence():
            for i in range(len(corners_m)):
                mesh, picture = face_files(folder, i)
                require_file(mesh, "mesh")  # which Bullet reads by itself
                shape = p.createVisualShape(
                    p.GEOM_MESH, fileName=name_in_text(str(mesh)), physicsClientId=client
                )
                body = p.createMultiBody(0, baseVisualShapeIndex=shape, physicsClientId=client)
                texture = self._load_texture(picture)
                p.changeVisualShape(body, -1, textureUniqueId=texture, physicsClientId=client)
                self._faces.append(body)
        self._shown = np.ones(len(corners_m), dtype=bool)
        return corners_m

    def _load_texture(self, picture: Path) -> int:
        """Load a picture; for EGL as one whose rows the plug-in reads right.

        It hands rows of 3 bytes a texel to OpenGL, which takes each to begin at a multiple of 4
        bytes: of any other width a picture comes out sheared.
        """
        p, client = self.bullet, self.client
        image = read_picture(picture)
        if self.renderer == "tiny":
            return p.loadTexture(name_in_text(str(picture)), physicsClientId=client)
        size = (-(-image.shape[1] // GL_ROW_TEXELS) * GL_ROW_TEXELS, image.shape[0])
        with tempfile.TemporaryDirectory() as folder:
            fitting = str(Path(folder) / "texture.bmp")
            if not cv2.imwrite(fitting, cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)):
                raise OSError(f"{fitting}: could not be written")
            return p.loadTexture(fitting, physicsClientId=client)

    def show_faces(self, shown: np.ndarray) -> None:
        """Show some of the painted faces (mask) and put the others out of sight."""
        for i in np.flatnonzero(shown != self._shown):
            height_m = 0.0 if shown[i] else OUT_OF_SIGHT_M
            self.bullet.resetBasePositionAndOrientation(
                self._faces[i], [0, 0, height_m], [0, 0, 0, 1], physicsClientId=self.client
            )
        self._shown = shown.copy()


def write_faces(
    folder: Path, plan: FloorPlan, rng: np.random.Generator, texture: Texture = DEFAULT_TEXTURE
) -> None:
    """Write each face's mesh and texture into `folder`; each texture has a child generator.

    Faces of one look have the picture that the first of them has.
    """
    faces = plan.faces()
    *children, of_posters = rng.spawn(len(faces) + 1)
    posters = paint_posters(texture, of_posters)
    seen: dict[str, np.ndarray] = {}
    for i, (face, child) in enumerate(zip(faces, children, strict=True)):
        mesh, path = face_files(folder, i)
        painted = seen[face.look] if face.look in seen else paint(face, child, texture, posters)
        if face.look:
            seen[face.look] = painted
        shown = np.ascontiguousarray(painted[:, ::-1]) if face.mirrored else painted
        picture = cv2.cvtColor(shown, cv2.COLOR_RGB2BGR)
        encoded = cv2.imencode(PICTURE, picture)[1].tobytes()
        # whole: another run may be painting, or looking at, the same walls
        write_whole(path, lambda file, data=encoded: file.write_bytes(data))
        write_whole(mesh, lambda file, face=face: file.write_text(_mesh(face), "ascii"))
    corners = io.BytesIO()
    np.save(corners, np.stack([face.corners_m for face in faces]))
    write_whole(folder / CORNERS, lambda file: file.write_bytes(corners.getvalue()))


def read_corners(path: Path) -> Float:
    """The corners (F, 4, 3) of all faces, as `write_faces` left them.

    Raises:
        DamagedFileError: they are missing or damaged.
    """
    require_file(path, "array of faces' corners")
    try:
        corners_m = np.asarray(np.load(io.BytesIO(path.read_bytes())), dtype=np.float64)
    except Exception as error:  # numpy has Python parse the header, which may raise anything
        reason = " ".join(str(error).split())
        raise DamagedFileError(path, f"is no array ({reason})") from error
    if corners_m.shape[1:] != (4, 3) or not np.isfinite(corners_m).all():
        raise DamagedFileError(path, "holds no corners (F, 4, 3) of faces")
    return corners_m


def read_picture(path: Path) -> np.ndarray:
    """Return the picture of a face, (H, W, 3) uint8 in the order of OpenCV: blue, green, red.

    Raises:
        DamagedFileError: it is missing or damaged.
    """
    require_file(path, "picture")
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DamagedFileError(path, "is no picture")
    return image


def face_files(folder: Path, i: int) -> tuple[Path, Path]:
    """A face's mesh and its picture."""
    return folder / f"face_{i:04d}.obj", folder / f"face_{i:04d}{PICTURE}"


def _mesh(face: Face) -> str:
    """One quad as OBJ; with normals and texture coordinates, or the renderer draws nothing.

    The normals all point up. They only serve the light: TinyRenderer is told to use none, and EGL,
    which takes no such order, has its lamp above, so that it too shows each texture as painted.
    """
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in face.corners_m]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += ["vn 0 0 1"]
    lines += ["f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]
    return "\n".join(lines) + "\n"
