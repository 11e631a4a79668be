"""Try the steps of the container file in a plain root, without a network:

    python -m release.container_trial dist [BASE]

A second argument names the folder of a base system, such as one that `debootstrap` made with python3-venv; the
trial works on a copy. Without it, the root has this computer's system folders, read only, and this Python; /opt,
/tmp and the working folder are new and empty. It needs root and `unshare`.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

LENT: Final = ("/usr", "/bin", "/lib", "/lib64", "/etc/ld.so.cache")

LOOPBACK: Final = """
import fcntl, socket, struct
with socket.socket() as any_:
    fcntl.ioctl(any_, 0x8914, struct.pack("16sH", b"lo", 1 | 64))
"""
"""Sets the loopback up (SIOCSIFFLAGS), which a new network namespace has down; a container engine does so."""


def script(dist: Path, root: Path, base: Path | None) -> str:
    """Return a shell script that carries out COPY and RUN of the container file in a root, or a copy of `base`."""
    python = Path(sys.base_prefix)
    lines = ["set -e", f"{sys.executable} -c {shlex.quote(LOOPBACK)}", f"mount -t tmpfs none {root}"]
    folders = " ".join(
        f"{root}/{name}" for name in ("opt", "tmp", "proc", "dev", "etc", "root", "laboratory")
    )
    if base is not None:
        lines.append(f"cp -a {shlex.quote(str(base))}/. {root}")
    lines.append(f"mkdir -p {folders} {root}{python}")
    for place in () if base is not None else (*LENT, str(python)):
        if Path(place).is_symlink():
            lines.append(f"cp -a {place} {root}{place}")
        elif Path(place).is_dir():
            lines += [f"mkdir -p {root}{place}", f"mount --rbind {place} {root}{place}"]
        elif Path(place).is_file():
            lines.append(f"cp {place} {root}{place}")
    lines += [f"mount -t proc none {root}/proc", f"mount --rbind /dev {root}/dev"]
    path = f"{python}/bin:/usr/bin:/bin"
    for line in (dist / "Containerfile").read_text(encoding="utf-8").splitlines():
        word, _, rest = line.partition(" ")
        if word == "COPY":
            source, target = rest.split()
            lines.append(f"cp -r {shlex.quote(str(dist / source))} {root}{target}")
        elif word == "RUN":
            lines.append(f"echo {shlex.quote(line)}")
            lines.append(
                f"chroot {root} /usr/bin/env -i HOME=/root PATH={path} /bin/sh -c {shlex.quote(rest)}"
            )
    lines.append(
        f"chroot {root} /usr/bin/env -i HOME=/root PATH=/opt/bench/bin:{path} bench --help > /dev/null"
    )
    return "\n".join(lines)


def main() -> int:
    """Carry out the steps in a mount, process and network namespace of their own; return the exit status."""
    dist, *bases = [Path(one).absolute() for one in sys.argv[1:] or ["dist"]]
    with tempfile.TemporaryDirectory(prefix="bench-root-") as root:
        command = ["unshare", "--mount", "--net", "--pid", "--fork", "sh", "-c"]
        command.append(script(dist, Path(root), next(iter(bases), None)))
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
