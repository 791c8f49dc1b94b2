"""What recordings ask of a file system: a lock, a name, room kept free, and that it is on the disk."""

import ctypes
import errno
import fcntl
import os
from pathlib import Path

__all__ = ["NO_ROOM", "free_bytes", "keep_room", "sync_folder", "take_name", "try_lock", "why"]

NO_ROOM = {errno.ENOSPC, errno.EDQUOT}
"""What a disk, or a user's share of one, says when it is full."""

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of linux/falloc.h: blocks behind the end, which stays where it is
_LIBC = ctypes.CDLL(None, use_errno=True)


def free_bytes(folder: Path) -> int:
    """Return what is left in the folder's file system for who is not root.

    Raises:
        OSError: the folder is gone.
    """
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def keep_room(fd: int, offset: int, length: int) -> None:
    """Give the file blocks for these bytes without making it longer; they are its own until it is cut to a length.

    os.posix_fallocate would make it longer, and a crash would leave the zeros for a reader to wonder about.

    Raises:
        OSError: there is no room, or the file system cannot do this (EOPNOTSUPP).
    """
    call = getattr(_LIBC, "fallocate64", None) or _LIBC.fallocate
    if call(fd, _KEEP_SIZE, ctypes.c_int64(offset), ctypes.c_int64(length)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def try_lock(fd: int) -> bool:
    """Lock the file for its writer; False where another program, or another part of this one, has it."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def take_name(active: Path, path: Path) -> None:
    """Give the file its final name, for good: the folder is on the disk when this returns.

    Raises:
        FileExistsError: the name is another file's, which stays; so does the .active one.
        OSError: the disk refused.
    """
    try:
        os.link(active, path)  # unlike a rename, it fails where the name is taken
    except FileExistsError:
        if not path.samefile(active):  # it may have got so far before a crash
            raise
    active.unlink()
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the folder's entries."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def why(error: OSError) -> str:
    """Return the system's words in lower case.

    >>> why(OSError(28, "No space left on device"))
    'no space left on device'
    """
    return (error.strerror or str(error)).lower()
