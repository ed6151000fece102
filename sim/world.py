"""PyBullet world: one client with collision walls for driving or painted faces for rendering."""

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
from mapfusion.files import name_in_text, require_file, write_atomically
from mapfusion.geometry.numerics import Float
from sim.floorplan import FloorPlan
from sim.renderer import BulletRenderer, egl_driver, load_egl, require_pybullet
from sim.textures import DEFAULT_TEXTURE, Texture, paint, paint_posters

GRAVITY_M_S2 = 9.81
PHYSICS_HZ = 240  # PyBullet's default, for which contacts and motors are tuned
CORNERS = "corners.npy"  # of all faces, beside their meshes and textures
# Uncompressed: each rendering process reads all textures, and decompression takes ten times as
# long. Their size is small compared to that of the features.
PICTURE = ".bmp"
OUT_OF_SIGHT_M = -100.0  # height below the floor at which hidden bodies are kept

GL_ROW_TEXELS = 4  # OpenGL's default row alignment
# Bit masks of collisions; wheels collide with the ground only.
GROUND, WHEEL, BODY = 1, 2, 4


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Suppress output of C code: redirect the file descriptors of stdout and stderr.

    PyBullet writes with C's printf, which bypasses `sys.stdout`.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    libc = ctypes.CDLL(None)
    libc.fflush(None)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    saved = {}
    for fd in (1, 2):
        with contextlib.suppress(OSError):  # a closed descriptor
            saved[fd] = os.dup(fd)
    try:
        for fd in saved:
            os.dup2(nowhere, fd)
        yield
    finally:
        libc.fflush(None)  # discard output that C still buffers
        for fd, copy in saved.items():
            os.dup2(copy, fd)
            os.close(copy)
        os.close(nowhere)


class World:
    """PyBullet client without a screen, for a `with` block.

    Args:
        renderer: renderer of the client; raises InputError without PyBullet or if it does not work.

    Attributes:
        renderer: renderer of the client.
        bullet: the `pybullet` module.
        client: id to pass as `physicsClientId`.
    """

    def __init__(self, renderer: BulletRenderer = "tiny") -> None:
        require_pybullet()
        if renderer == "egl":
            egl_driver()  # raises InputError without a driver
        self.renderer = renderer
        with silence():
            import pybullet

            self.bullet = pybullet
            self.client = pybullet.connect(pybullet.DIRECT)
            if renderer == "egl":
                load_egl(pybullet, self.client)
                atexit.register(self.close)  # an open client would write to stdout at exit
        self._faces: list[int] = []
        self._shown = np.zeros(0, dtype=bool)
        # otherwise a mesh file that was rewritten would be shown in its old state
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
        """Disconnect; a second call has no effect."""
        if self.client >= 0:
            with silence():
                self.bullet.disconnect(physicsClientId=self.client)
            self.client = -1
            atexit.unregister(self.close)

    def start_physics(self) -> int:
        """Set gravity and time step and add a flat ground; return the ground's body id."""
        p, client = self.bullet, self.client
        p.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=1 / PHYSICS_HZ,
            deterministicOverlappingPairs=1,
            # PyBullet's friction cone is aligned with the world's axes. With the cone the effective
            # track of a turning robot varies by a factor of 4 with its heading, else by 20 %.
            enableConeFriction=0,
            physicsClientId=client,
        )
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        ground = p.createMultiBody(0, plane, physicsClientId=client)
        p.changeDynamics(ground, -1, lateralFriction=1.0, physicsClientId=client)
        p.setCollisionFilterGroupMask(ground, -1, GROUND, WHEEL | BODY, physicsClientId=client)
        return ground

    def step(self, n: int) -> None:
        """Simulate n steps of 1/240 s."""
        for _ in range(n):
            self.bullet.stepSimulation(physicsClientId=self.client)

    def add_solid_wall(self, start: Float, end: Float, thickness_m: float, height_m: float) -> None:
        """Add a wall from `start` to `end`, shape (2,) each, as a collision box."""
        p, client = self.bullet, self.client
        along = end - start
        half = [float(np.linalg.norm(along)) / 2, thickness_m / 2, height_m / 2]
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
        wall = p.createMultiBody(
            0,
            shape,
            basePosition=[*((start + end) / 2), height_m / 2],
            baseOrientation=p.getQuaternionFromEuler([0, 0, np.arctan2(along[1], along[0])]),
            useMaximalCoordinates=1,  # PyBullet checks every pair of other static bodies
            physicsClientId=client,
        )
        p.setCollisionFilterGroupMask(wall, -1, BODY, BODY, physicsClientId=client)

    def add_painted_faces(self, folder: Path) -> Float:
        """Load the faces that `write_faces` wrote to `folder`, without collision shapes.

        Returns:
            Corners of the faces, shape (F, 4, 3).

        Raises:
            DamagedFileError: a file of the folder is missing or damaged.
        """
        p, client = self.bullet, self.client
        corners_m = read_corners(folder / CORNERS)
        with silence(), tempfile.TemporaryDirectory() as temporary:
            for i in range(len(corners_m)):
                mesh, picture = face_files(folder, i)
                require_file(mesh, "mesh")  # PyBullet would not name a missing file
                shape = p.createVisualShape(
                    p.GEOM_MESH, fileName=name_in_text(str(mesh)), physicsClientId=client
                )
                body = p.createMultiBody(0, baseVisualShapeIndex=shape, physicsClientId=client)
                image = read_picture(picture)
                if self.renderer != "tiny":
                    # The EGL plug-in passes rows of 3 bytes per texel to OpenGL, which expects rows
                    # aligned to 4 bytes. A texture with another width would be sheared.
                    width = -(-image.shape[1] // GL_ROW_TEXELS) * GL_ROW_TEXELS
                    image = cv2.resize(image, (width, len(image)), interpolation=cv2.INTER_LINEAR)
                    picture = Path(temporary) / f"{i}.bmp"
                    if not cv2.imwrite(str(picture), image):
                        raise OSError(f"{picture}: could not be written")
                texture = p.loadTexture(name_in_text(str(picture)), physicsClientId=client)
                p.changeVisualShape(body, -1, textureUniqueId=texture, physicsClientId=client)
                self._faces.append(body)
        self._shown = np.ones(len(corners_m), dtype=bool)
        return corners_m

    def show_faces(self, shown: np.ndarray) -> None:
        """Show the painted faces selected by a mask (F,) and hide the others."""
        for i in np.flatnonzero(shown != self._shown):
            height_m = 0.0 if shown[i] else OUT_OF_SIGHT_M
            self.bullet.resetBasePositionAndOrientation(
                self._faces[i], [0, 0, height_m], [0, 0, 0, 1], physicsClientId=self.client
            )
        self._shown = shown.copy()


def write_faces(
    folder: Path, plan: FloorPlan, rng: np.random.Generator, texture: Texture = DEFAULT_TEXTURE
) -> None:
    """Write mesh and texture of each face to `folder`.

    Each texture is drawn from a child generator of its own. Faces of the same look have the texture
    of the first of them.
    """
    faces = plan.faces()
    *children, of_posters = rng.spawn(len(faces) + 1)
    posters = paint_posters(texture, of_posters)
    painted_faces: dict[str, np.ndarray] = {}
    for i, (face, child) in enumerate(zip(faces, children, strict=True)):
        mesh, path = face_files(folder, i)
        painted = (
            painted_faces[face.look]
            if face.look in painted_faces
            else paint(face, child, texture, posters)
        )
        if face.look:
            painted_faces[face.look] = painted
        shown = np.ascontiguousarray(painted[:, ::-1]) if face.mirrored else painted
        picture = cv2.cvtColor(shown, cv2.COLOR_RGB2BGR)
        encoded = cv2.imencode(PICTURE, picture)[1].tobytes()
        # files are written whole: another run may write or read the same faces
        write_atomically(path, lambda file, data=encoded: file.write_bytes(data))
        # OBJ text, with the normals and texture coordinates that PyBullet needs. All normals point
        # up: they only affect the lighting, and the lamp of EGL is above.
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in face.corners_m]
        lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
        lines += ["vn 0 0 1"]
        lines += ["f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]
        text = "\n".join(lines) + "\n"
        write_atomically(mesh, lambda file, text=text: file.write_text(text, "ascii"))
    corners = io.BytesIO()
    np.save(corners, np.stack([face.corners_m for face in faces]))
    write_atomically(folder / CORNERS, lambda file: file.write_bytes(corners.getvalue()))


def read_corners(path: Path) -> Float:
    """Read the corners (F, 4, 3) of all faces that `write_faces` wrote.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    require_file(path, "array of faces' corners")
    try:
        corners_m = np.asarray(np.load(io.BytesIO(path.read_bytes())), dtype=np.float64)
    except Exception as error:  # parsing the header may raise any error
        reason = " ".join(str(error).split())
        raise DamagedFileError(path, f"is no array ({reason})") from error
    if corners_m.shape[1:] != (4, 3) or not np.isfinite(corners_m).all():
        raise DamagedFileError(path, "holds no corners (F, 4, 3) of faces")
    return corners_m


def read_picture(path: Path) -> np.ndarray:
    """Read the texture of a face, shape (H, W, 3) uint8 in the order blue, green, red.

    Raises:
        DamagedFileError: the file is missing or damaged.
    """
    require_file(path, "picture")
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DamagedFileError(path, "is no picture")
    return image


def face_files(folder: Path, i: int) -> tuple[Path, Path]:
    """Return the paths of a face's mesh and texture."""
    return folder / f"face_{i:04d}.obj", folder / f"face_{i:04d}{PICTURE}"
