"""Plug-ins for tests: a module, and the metadata of an installed package."""

from pathlib import Path

from experiments.plugins import discovery

MODULE = """
import ctypes, os, pickle, signal, socket, sys, time
import numpy as np
from dataclasses import replace
from mapfusion.align.alignment import Alignment, Status, degenerate

GOOD_T, GOOD_COVARIANCE = np.array([1.0, 2.0, 0.5]), np.diag([1.0, 4.0, 0.01])


class Method:
    randomised = True

    def __init__(self, what="good", seconds=0.0):
        if what == "unknown":
            raise ValueError("what: is unknown")
        if what == "cannot be made":
            raise RuntimeError("no licence")
        if what == "dies when made":
            os._exit(4)
        if what == "randomised is no bool":
            self.randomised = "yes"
        self.what, self.seconds, self.calls = what, seconds, 0

    def align(self, map_a, map_b, correspondences, rng):
        self.calls += 1
        n = len(correspondences)
        T_a_b = GOOD_T + rng.normal(0, 1e-3, 3)
        good = Alignment(T_a_b, GOOD_COVARIANCE, np.ones(n, bool), 99.0, Status.ACCEPTED, "", 0.1)
        good.T_a_b[0] += self.calls
        what = self.what
        print("noise on stdout", flush=True)
        print("noise on stderr", file=sys.stderr, flush=True)
        time.sleep(self.seconds)
        if what == "good":
            return good
        if what == "counts its threads":
            import cv2, scipy.linalg, threadpoolctl

            threads = [library["num_threads"] for library in threadpoolctl.threadpool_info()]
            return replace(good, T_a_b=np.array([cv2.getNumThreads(), max(threads), 0.0]))
        if what == "grows":
            self.kept = getattr(self, "kept", []) + [np.ones(2**18)]  # 2 MB
            return good
        if what == "sums":  # of all it was given
            total = sum(float(np.sum(m.position_m)) for m in (map_a, map_b))
            return replace(good, T_a_b=np.array([total, float(n), 0.0]))
        if what == "spoils its maps":
            map_a.position_m[:] = 7.0
            return replace(good, T_a_b=np.array([map_b.position_m.sum(), 0.0, 0.0]))
        if what == "raises":
            raise KeyError("no such\\nlandmark")
        if what == "exits":
            sys.exit(3)
        if what == "exits at once":
            os._exit(3)
        if what == "segfaults":
            ctypes.string_at(0)
        if what == "kills itself":
            os.kill(os.getpid(), signal.SIGKILL)
        if what == "hangs":
            time.sleep(100_000)
        if what == "hangs with the lock held":
            ctypes.PyDLL(None).sleep(100_000)
        if what == "writes a byte now and then":
            for octet in b"x" * 20 + b"\\n":  # longer than the limit, each byte in time
                os.write(int(sys.argv[1]), bytes([octet]))
                time.sleep(0.1)
        if what == "shuts its side of the connection":
            socket.socket(fileno=os.dup(int(sys.argv[1]))).shutdown(socket.SHUT_WR)
            time.sleep(100_000)
        if what == "writes a pickle":
            call = type("Call", (), {"__reduce__": lambda self: (print, ("unpickled",))})()
            os.write(int(sys.argv[1]), pickle.dumps(call) + b"\\n")
            time.sleep(100_000)
        if what == "answers another request":
            os.write(int(sys.argv[1]), b'{"token": "another", "error": "no"}\\n')
            time.sleep(100_000)
        if what == "closes everything":
            os.closerange(0, 64)
            time.sleep(100_000)
        if what == "wrong type":
            return (1.0, 2.0, 0.5)
        if what == "none":
            return None
        if what == "degenerate":
            return degenerate("nothing to see", n)
        wrong = {
            "NaN": {"T_a_b": np.array([np.nan, 0.0, 0.0])},
            "list": {"T_a_b": [1.0, 2.0, 0.5]},
            "4 numbers": {"T_a_b": np.zeros(4)},
            "theta out of range": {"T_a_b": np.array([0.0, 0.0, 4.0])},
            "inlier of another length": {"inlier": np.ones(n + 1, bool)},
            "inlier of numbers": {"inlier": np.ones(n)},
            "infinite covariance": {"covariance": np.full((3, 3), np.inf)},
            "asymmetric covariance": {"covariance": GOOD_COVARIANCE + np.eye(3, k=1)},
            "negative variance": {"covariance": np.diag([1.0, 1.0, -1.0])},
            "covariance of the plane": {"covariance": np.eye(2)},
            "claims to have failed": {"status": Status.FAILED, "reason": "no"},
            "refuses without a reason": {"status": Status.REFUSED},
            "reason is no text": {"reason": 7},
            "drift is no number": {"drift_sigma_m": None},
            "degenerate with a motion": {"status": Status.DEGENERATE, "reason": "no"},
        }
        return replace(good, **wrong[what])
"""


def install(
    folder: Path,
    name: str = "made_up",
    package: str = "made-up",
    version: str = "1.0",
    target: str = "made_up_module:Method",
    code: str = MODULE,
) -> None:
    """Put the package into a folder that is, or will be, on the path."""
    folder.mkdir(exist_ok=True)
    (folder / f"{target.partition(':')[0]}.py").write_text(code, encoding="utf-8")
    info = folder / f"{package.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    points = f"[{discovery.ENTRY_POINTS}]\n{name} = {target}\n"
    (info / "entry_points.txt").write_text(points, encoding="utf-8")


def look_again() -> None:
    """Forget the installed packages and their hashes."""
    discovery.declared.cache_clear()
    discovery.fingerprint.cache_clear()
