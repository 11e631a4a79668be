"""Build a release into a folder: `python -m release.build --out dist [--key FILE] [--bundle]`.

Wheel and sdist are built twice and must be equal, byte for byte. Their times are those of the last commit, or
SOURCE_DATE_EPOCH. `manifest.json` holds the SHA-256 of every file of the release, of every file of the program as
installed, and the versions of its packages; `bench validate --release manifest.json` compares an installation.
"""

from __future__ import annotations

import argparse
import base64
import getpass
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bench.base.files import to_text
from bench.run.events import RecordError, sha256
from bench.run.seal import private_key, sign
from bench.services.validated import DISTRIBUTION, packages
from release.bill import bill, licences

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

ROOT: Final = Path(__file__).parents[1]
SHIPPED: Final = "bench/shipped_files/procedures/"
OURS: Final = ("bench/", "drivers/", "sim/")
BESIDE: Final = (
    "constraints.txt", "LICENSE", "CHANGELOG.md", "release/Containerfile", "config/systemd/bench-panel.service",
)  # fmt: skip
"""Files that a release has beside what it builds."""


def epoch_s() -> int:
    """Return the time of the release, s since 1970: SOURCE_DATE_EPOCH, else that of the last commit."""
    stated = os.environ.get("SOURCE_DATE_EPOCH")
    if stated:
        return int(stated)
    git = ["git", "-C", str(ROOT), "log", "-1", "--format=%ct"]
    return int(subprocess.run(git, capture_output=True, check=True, text=True).stdout)


def built_twice(out: Path, when: int) -> list[Path]:
    """Build wheel and sdist twice; return them in `out`. Ends the program if the two differ."""
    environment = {
        **os.environ,
        "SOURCE_DATE_EPOCH": str(when),
        "PIP_CONSTRAINT": str(ROOT / "constraints.txt"),
    }
    environment.pop("PYTHONPATH", None)
    found: list[dict[str, bytes]] = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as place:
            # from a copy of what is under version control, so that nothing else gets in
            archive, source = Path(place) / "source.tar", Path(place) / "source"
            source.mkdir()
            subprocess.run(["git", "-C", str(ROOT), "archive", "-o", str(archive), "HEAD"], check=True)
            shutil.unpack_archive(archive, source)
            command = [sys.executable, "-m", "build", "--outdir", f"{place}/made", str(source)]
            subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
            found.append({one.name: one.read_bytes() for one in sorted(Path(place, "made").iterdir())})
    if found[0] != found[1]:
        differing = [name for name in found[0] if found[0][name] != found[1].get(name)]
        raise SystemExit(f"not reproducible: {', '.join(differing)}; two builds differ")
    for name, content in found[0].items():
        (out / name).write_bytes(content)
    return [out / name for name in found[0]]


def program_files(wheel: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of the program by the path under which `bench validate` knows it."""
    files = {}
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.startswith(OURS):
                files[name] = sha256(archive.read(name))
            if name.startswith(SHIPPED):
                files[f"procedures/{name.removeprefix(SHIPPED)}"] = files[name]
    return dict(sorted(files.items()))


def download(out: Path, wheel: Path) -> None:
    """Download the wheels of all packages of the pins into `out`/bundle, for an installation without a network."""
    bundle = out / "bundle"
    bundle.mkdir()
    pins = "".join(f"{one.name}=={one.version}\n" for one in packages() if one.name != DISTRIBUTION)
    (bundle / "requirements.txt").write_text(pins, encoding="utf-8")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
    subprocess.run([*command, "-r", str(bundle / "requirements.txt"), "-d", str(bundle)], check=True)
    shutil.copy(wheel, bundle)


def write_manifest(out: Path, wheel: Path, key: Ed25519PrivateKey | None) -> None:
    """Write `manifest.json` over everything in `out`, and its signature beside it."""
    listed = {
        one.relative_to(out).as_posix(): sha256(one.read_bytes())
        for one in sorted(out.rglob("*"))
        if one.is_file()
    }
    manifest = {
        "name": DISTRIBUTION,
        "version": wheel.name.split("-")[1],
        "files": listed,
        "program": program_files(wheel),
        "packages": {one.name: one.version for one in packages() if one.name != DISTRIBUTION},
    }
    content = to_text(manifest).encode()
    (out / "manifest.json").write_bytes(content)
    if key is not None:
        pem, signature = sign(key, content)
        (out / "manifest.json.sig").write_bytes(base64.b64encode(signature) + b"\n")
        (out / "release.pub").write_text(pem, encoding="ascii")


def main() -> None:
    """Build a release as the arguments say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("dist"))
    parser.add_argument("--key", type=Path, help="private key (Ed25519, 'bench key') that signs the manifest")
    parser.add_argument(
        "--bundle", action="store_true", help="also download the packages for offline installation"
    )
    asked = parser.parse_args()
    key = None
    if asked.key is not None:
        try:
            key = private_key(asked.key, lambda: getpass.getpass("passphrase of the key: ").encode())
        except RecordError as error:
            raise SystemExit(str(error)) from error
    out: Path = asked.out
    if out.exists() and any(out.iterdir()):
        raise SystemExit(f"{out}: is not empty; remove it, or name another with --out (make release OUT=DIR)")
    out.mkdir(parents=True, exist_ok=True)
    when = epoch_s()
    wheel = next(one for one in built_twice(out, when) if one.suffix == ".whl")
    found = bill(when)
    (out / "sbom.cdx.json").write_text(to_text(found), encoding="utf-8")
    (out / "licences.tsv").write_text(licences(found), encoding="utf-8")
    for name in BESIDE:
        shutil.copy(ROOT / name, out)
    if asked.bundle:
        download(out, wheel)
    write_manifest(out, wheel, key)
    for one in sorted(out.iterdir()):
        size = "" if one.is_dir() else sha256(one.read_bytes())
        print(f"{size:64}  {one}")
    if key is None:
        print("the manifest is not signed; --key FILE signs it")


if __name__ == "__main__":
    main()
