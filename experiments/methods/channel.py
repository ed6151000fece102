"""What a plug-in's process and the harness send each other, over a pair of sockets.

A plug-in can write whatever it likes into its process' end. So an answer counts only in a frame
that begins with the secret of its own request and is of a sane size; anything else is told apart at
once, without being read as anything.
"""

import secrets
import socket
import struct
import time

_FRAME = struct.Struct("!16sQ")  # the request's secret, and how many bytes follow
# An answer has one bit for each correspondence, in hexadecimal: enough for tens of millions.
_MOST_ANSWER_BYTES = 2**24
_PIECE_BYTES = 2**20


class GarbledError(Exception):
    """Bytes arrived that are no answer to the request."""


class Channel:
    """One end, for one request at a time."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    @property
    def closed(self) -> bool:
        """Whether this end was closed."""
        return self._end.fileno() < 0

    def close(self) -> None:
        """Close this end."""
        self._end.close()

    def ask(self, request: bytes, limit_s: float) -> bytes:
        """The other side's answer.

        Raises:
            TimeoutError: there was none, or none whole, after so many seconds.
            GarbledError: what came is none.
            EOFError, OSError: the other end is closed.
        """
        deadline_s = time.monotonic() + limit_s
        secret = secrets.token_bytes(16)
        self._end.settimeout(limit_s)
        self._end.sendall(_FRAME.pack(secret, len(request)) + request)
        echoed, size = _FRAME.unpack(self._receive(_FRAME.size, deadline_s))
        if echoed != secret or size > _MOST_ANSWER_BYTES:
            raise GarbledError
        return self._receive(size, deadline_s)

    def next_request(self) -> tuple[bytes, bytes]:
        """Wait for a request, with the secret to answer it with; EOFError: none will come."""
        self._end.settimeout(None)
        secret, size = _FRAME.unpack(self._receive(_FRAME.size))
        return secret, self._receive(size)

    def answer(self, secret: bytes, text: bytes) -> None:
        """Answer the request that came with this secret."""
        self._end.sendall(_FRAME.pack(secret, len(text)) + text)

    def _receive(self, size: int, deadline_s: float | None = None) -> bytes:
        parts, missing = [], size
        while missing:
            if deadline_s is not None:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise TimeoutError
                self._end.settimeout(left_s)
            part = self._end.recv(min(missing, _PIECE_BYTES))
            if not part:
                raise EOFError
            parts.append(part)
            missing -= len(part)
        return b"".join(parts)
