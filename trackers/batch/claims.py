"""Which process tracks which recording: files in a folder that any number of machines share.

A claim is a file `NAME.0`, made with `O_EXCL`, which only one process can make, over NFS too. Whoever takes over a
recording makes the file of the next number, which again only one can make; the highest number is the one that counts,
and the others are the history. The holder touches its file; a claim is stale when a watcher has not observed a change
for long enough, by its own clock: clocks of machines need not agree.
"""

import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.json_files import read_json

BEATS = 6
"""Signs of life within the time after which a claim is stale."""


class Claim(NamedTuple):
    """The right to track one recording."""

    name: str
    number: int
    attempts: int
    """Earlier ones that ended without a result, other than by a person or a scheduler."""


class Claims:
    """The claims in one folder, as one process sees them."""

    def __init__(self, folder: Path, stale_s: float, clock: Callable[[], float] = time.monotonic):
        """Claims in `folder`, which exists; stale after `stale_s` seconds by `clock`."""
        self._folder, self._stale_s, self._clock = folder, stale_s, clock
        self._watched: dict[str, tuple[tuple[int, int], float]] = {}
        self._last_beat = clock()

    def numbers(self) -> dict[str, int]:
        """The highest number for each recording that was ever claimed."""
        found: dict[str, int] = {}
        for entry in os.scandir(self._folder):
            name, _, number = entry.name.rpartition(".")
            # Files that begin with a dot are still being written.
            if number.isdecimal() and not name.startswith("."):
                found[name] = max(found.get(name, 0), int(number))
        return found

    def is_free(self, name: str, number: int | None) -> bool:
        """Whether a recording whose highest claim is `number` (None: never claimed) may be taken."""
        if number is None:
            return True
        claim = self._read(name, number)
        if claim.get("state", "held") != "held":
            return True
        if claim.get("machine") == machine() and not _is_alive(claim.get("pid")):
            return True
        return self._is_stale(self._path(name, number))

    def take(self, name: str, number: int | None) -> Claim | None:
        """Claim a recording whose highest claim is `number`; None if another process was faster."""
        mine = 0 if number is None else number + 1
        try:
            with self._path(name, mine).open(mode="x") as file:
                file.write(_content("held"))
        except FileExistsError:
            return None
        earlier = [self._read(name, i).get("state") for i in range(mine)]
        return Claim(name, mine, sum(state != "released" for state in earlier))

    def beat(self, claims: list[Claim]) -> list[Claim]:
        """Give a sign of life for `claims` if it is time, and return those that were taken over meanwhile."""
        now = self._clock()
        if now - self._last_beat < self._stale_s / BEATS:
            return []
        self._last_beat = now
        lost = []
        for claim in claims:
            try:
                os.utime(self._path(claim.name, claim.number))
            except FileNotFoundError:
                lost.append(claim)
                continue
            if self._path(claim.name, claim.number + 1).exists():
                lost.append(claim)
        return lost

    def release(self, claim: Claim, *, counts: bool) -> None:
        """Let others take it at once; `counts` says whether this was an attempt that failed by itself."""
        path = self._path(claim.name, claim.number)
        write_whole(path, _content("ended" if counts else "released"))

    def forget(self, names: list[str]) -> None:
        """Remove the history of recordings that nobody tracks."""
        for path in list(self._folder.iterdir()):
            if path.name.rpartition(".")[0] in names:
                path.unlink(missing_ok=True)

    def _path(self, name: str, number: int) -> Path:
        return self._folder / f"{name}.{number}"

    def _read(self, name: str, number: int) -> dict[str, Any]:
        """What a claim says; nothing while its holder still writes it."""
        try:
            return read_json(self._path(name, number), "expected a claim of a batch")
        except InputError:
            return {}

    def _is_stale(self, path: Path) -> bool:
        try:
            status = path.stat()
        except FileNotFoundError:
            return False
        change, now = (status.st_mtime_ns, status.st_size), self._clock()
        before, since = self._watched.get(path.name, (None, now))
        if before != change:
            self._watched[path.name] = change, now
            return False
        return now - since >= self._stale_s


def machine() -> str:
    """A name that two processes share only if each can tell whether the other lives: of the host and its processes."""
    try:
        # Containers may share the name of their host, but number their processes for themselves.
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return f"{socket.gethostname()} {space}".strip()


def write_whole(path: Path, text: str) -> None:
    """Write a file that several processes may write: readers find the old text or the new one."""
    partial = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}")
    try:
        partial.write_text(text)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _content(state: str) -> str:
    return json.dumps({"machine": machine(), "pid": os.getpid(), "state": state})


def _is_alive(pid: Any) -> bool:
    # On other systems `os.kill` with signal 0 ends the process.
    if not isinstance(pid, int) or os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True
