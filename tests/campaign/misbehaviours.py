"""Misbehaving plug-ins: bodies of their methods as source text."""

HEAD = """
import builtins, ctypes, faulthandler, json, os, pickle, resource, signal, socket
import stat, struct, sys, threading, time
from dataclasses import dataclass, replace
import numpy as np
from mapfusion.align.alignment import Fit, Undetermined
from mapfusion.align.alignment import Alignment, Status, degenerate

T, COVARIANCE = np.array([1.0, 2.0, 0.5]), np.diag([1.0, 4.0, 0.01])


def sockets():
    return [number for number in range(3, 256) if is_socket(number)]


def is_socket(number):
    try:
        return stat.S_ISSOCK(os.fstat(number).st_mode)
    except OSError:
        return False


def send(octets):
    for number in sockets():
        os.write(number, octets)
"""
ALIGN = """

class Method:
    randomised = False

    def align(self, map_a, map_b, correspondences, rng):
        n = len(correspondences)
        good = Alignment(T, COVARIANCE, np.ones(n, bool), 1.0, Status.ACCEPTED, "", 0.1)
        {body}
        return good
"""
FIND = """

class Method:
    randomised = False

    def find(self, pairs, rng):
        every = np.ones(len(pairs), bool)
        {body}
        return Fit(T, every)
"""
# In place of a good answer; each is a recorded failure.
OF_ALIGN = {
    "raises": "raise KeyError('no such\\nlandmark')",
    "raises an interrupt": "raise KeyboardInterrupt",
    "raises an exit": "sys.exit('over')",
    "raises what ends generators": "raise GeneratorExit",
    "raises a lone surrogate": "raise ValueError('\\udc80')",
    "raises NUL and escape": "raise ValueError('\\0 \\x1b[31m red')",
    "raises a text of megabytes": "raise ValueError('x' * 2**22)",
    "raises what cannot be told": (
        "raise type('E', (Exception,), {'__str__': lambda self: 1 / 0})()"
    ),
    "raises what tells a number": "raise type('E', (Exception,), {'__str__': lambda self: 7})()",
    "raises a class named by a surrogate": "raise type('E\\udcff', (Exception,), {})('no')",
    "raises from a file named by a surrogate": ("exec(compile('1 / 0', 'a\\udc80.py', 'exec'))"),
    "recurses for ever": "self.align(map_a, map_b, correspondences, rng)",
    "asks for more memory than there is": "np.ones(2**56)",
    "ends its process well": "os._exit(0)",
    "ends its process badly": "os._exit(3)",
    "aborts": "os.abort()",
    "reads address 0": "ctypes.string_at(0)",
    "dies of SIGKILL": "os.kill(os.getpid(), signal.SIGKILL)",
    "dies of SIGTERM": "os.kill(os.getpid(), signal.SIGTERM)",
    "dies of SIGALRM": "signal.setitimer(signal.ITIMER_REAL, 0.05); time.sleep(60)",
    "dies of a real-time signal": "os.kill(os.getpid(), 40)",
    "dies of the last signal": "os.kill(os.getpid(), signal.SIGRTMAX)",
    "is ended by a timer": "faulthandler.dump_traceback_later(0.05, exit=True); time.sleep(60)",
    "runs out of processor time": (
        "resource.setrlimit(resource.RLIMIT_CPU, (0, 0))\n        while True: pass"
    ),
    "writes a word": "send(b'hello')",
    "writes a byte": "send(b'x')",
    "writes a pickle": "send(pickle.dumps(good))",
    "writes a pickle that claims memory": "send(b'\\x80\\x05\\x8e' + b'\\xff' * 8)",
    "writes a frame that claims memory": "send(struct.pack('!16sQ', b'', 2**63))",
    "writes an answer of its own": "send(struct.pack('!16sQ', b'', 2) + b'{}')",
    "writes an old length and a pickle": "send(struct.pack('!i', 2**31 - 1) + pickle.dumps(1))",
    "writes a line of JSON": 'send(b\'{"token": "", "error": "no"}\\n\')',
    "writes a pickle and ends the line": "send(pickle.dumps(good) + b'\\n')",
    "eats memory until none is left": (
        "pages = int(open('/proc/self/statm').read().split()[0])\n"
        "        most = pages * resource.getpagesize() + 2**28\n"
        "        resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
        "        kept = []\n"
        "        while True: kept.append(np.ones(2**20))"
    ),
    "writes megabytes": (
        "threading.Thread(target=send, args=(bytes(2**24),), daemon=True).start()\n"
        "        time.sleep(0.1)"
    ),
    "writes between two calls": "threading.Timer(0.02, send, (b'late',)).start()",
    "closes the connection": "[os.close(k) for k in sockets()]",
    "closes all that is open": "os.closerange(0, 256)",
    "shuts the connection": "socket.socket(fileno=sockets()[0]).shutdown(socket.SHUT_RDWR)",
    "dies between two calls": "threading.Timer(0.02, os._exit, (1,)).start()",
    "changes how JSON is written": "json.dumps = lambda *_, **__: 'no JSON'",
    "changes how JSON is written to another value": "json.dumps = lambda *_, **__: '[1]'",
    "changes what is finite": (
        "np.isfinite = lambda x: np.ones(np.shape(x), bool)\n"
        "        good = replace(good, T_a_b=T * np.nan)"
    ),
    "changes what is checked": (
        "module = sys.modules['__main__']\n"
        "        module.checked_answer = lambda answer, *_: answer\n"
        "        good = replace(good, drift_sigma_m=-5.0)"
    ),
    "removes a builtin": "del builtins.isinstance",
    "leaves no stack": "sys.setrecursionlimit(sys.getrecursionlimit()); self.__dict__ = None",
    "returns nothing": "return None",
    "returns a tuple": "return 1.0, 2.0, 0.5",
    "returns a class": "return Alignment",
    "returns one that raises when read": (
        "return type('A', (Alignment,), {'status': property(lambda self: 1 / 0)})"
        "(*vars(good).values())"
    ),
}
_WRONG = {
    "NaN motion": "T_a_b=T * np.nan",
    "infinite motion": "T_a_b=T * np.inf",
    "list for a motion": "T_a_b=[1.0, 2.0, 0.5]",
    "motion of 4 numbers": "T_a_b=np.zeros(4)",
    "whole numbers for a motion": "T_a_b=np.zeros(3, int)",
    "complex motion": "T_a_b=T * 1j",
    "objects for a motion": "T_a_b=T.astype(object)",
    "masked motion": "T_a_b=np.ma.masked_array(T, [True, False, False])",
    "motion as a matrix": "T_a_b=np.asmatrix(T)",
    "longdouble motion that overflows": "T_a_b=T.astype('g') * np.longdouble('1e400')",
    "angle of 4 rad": "T_a_b=np.array([0.0, 0.0, 4.0])",
    "no covariance": "covariance=COVARIANCE * np.nan",
    "infinite covariance": "covariance=np.full((3, 3), np.inf)",
    "asymmetric covariance": "covariance=COVARIANCE + np.eye(3, k=1)",
    "negative variance": "covariance=-COVARIANCE",
    "covariance of the plane": "covariance=np.eye(2)",
    "masked covariance": "covariance=np.ma.masked_array(COVARIANCE, COVARIANCE > 2)",
    "longdouble covariance that overflows": (
        "covariance=COVARIANCE.astype('g') * np.longdouble('1e400')"
    ),
    "one inlier more": "inlier=np.ones(n + 1, bool)",
    "numbers for inliers": "inlier=np.ones(n)",
    "masked inliers": "inlier=np.ma.masked_array(np.ones(n, bool), np.ones(n, bool))",
    "claims to have failed": "status=Status.FAILED, reason='no'",
    "claims to be absent": "status=Status.ABSENT, reason='no'",
    "unknown status": "status='wonderful'",
    "no status": "status=None",
    "accepted by another name": "status='accepted', covariance=COVARIANCE * np.nan, reason='x'",
    "refused without a reason": "status=Status.REFUSED",
    "refused for white space": "status=Status.REFUSED, reason=' \\n'",
    "reason is a number": "reason=7",
    "reason is bytes": "reason=b'no'",
    "degenerate with a motion": "status=Status.DEGENERATE, reason='no'",
    "no drift": "drift_sigma_m=None",
    "NaN drift": "drift_sigma_m=np.nan",
    "infinite drift": "drift_sigma_m=np.inf",
    "negative drift": "drift_sigma_m=-5.0",
    "longdouble drift that overflows": "drift_sigma_m=np.longdouble('1e400')",
    "masked drift": "drift_sigma_m=np.ma.masked",
}
OF_ALIGN |= {name: f"return replace(good, {change})" for name, change in _WRONG.items()}
OF_FIND = {
    "finds nothing": "return None",
    "finds a masked motion": "return Fit(np.ma.masked_array(T, True), every)",
    "finds a longdouble motion that overflows": "return Fit(T * np.longdouble('1e400'), every)",
    "finds masked weights": "return Fit(T, every, np.ma.masked_array(every * 1.0, True))",
    "finds with weights that overflow": ("return Fit(T, every, every * np.longdouble('1e400'))"),
    "finds with negative weights": "return Fit(T, every, -1.0 * every)",
    "finds nothing for no reason": "return Undetermined('')",
    "finds a surrogate": "raise ValueError('\\ud800')",
}
# These end with the time limit: it is short.
SLOW = {
    "sleeps": "time.sleep(600)",
    "sleeps with the lock held": "ctypes.PyDLL(None).sleep(600)",
    "works for ever": "while True: pass",
    "writes a byte now and then": "while True: send(b'x'); time.sleep(0.1)",
    "stops its process": "os.kill(os.getpid(), signal.SIGSTOP)",
    "stops its process between two calls": (
        "threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGSTOP)).start()"
    ),
    "reads requests between two calls": (
        "threading.Thread(target=lambda: [os.read(k, 9) for k in sockets()], daemon=True).start()"
    ),
    "writes half a frame and sleeps": "send(b'12345'); time.sleep(600)",
    "turns the connection to nowhere": "[os.dup2(0, k) for k in sockets()]",
    "dies and leaves the connection to a fork": (
        "time.sleep(600) if os.fork() == 0 else os._exit(0)"
    ),
}
# At the import or when it is made: refused before a run, and a failure where it comes to one.
WHEN_MADE = {
    "no Python": "this is no Python",
    "no such class": "del Method",
    "raises when imported": "raise RuntimeError('no licence\\udc80')",
    "exits when imported": "sys.exit(3)",
    "dies when imported": "os._exit(4)",
    "dies of a signal when imported": "os.kill(os.getpid(), 40)",
    "writes when imported": "send(b'hello')",
    "is told apart by a surrogate": (
        "def made(self): raise ValueError('what: \\udc80')\nMethod.__init__ = made"
    ),
    "is random in words": "Method.randomised = 'yes\\udc80'",
    "is random by chance": "Method.randomised = property(lambda self: 1 / 0)",
}
