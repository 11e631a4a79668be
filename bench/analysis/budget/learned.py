"""The stand's errors as they were learned, in place of the limits: means that mountings share, and the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.calibration.known import KnownNoise, KnownStand
from bench.base.arrays import CHANNELS, Floats, rms
from bench.model import STAND_ANGLES, Distribution, Mounting

MEANS: Final = "stand_means"
LEARNED: Final = "learned of the bench"


def learned_sources(
    stated: Sequence[ErrorSource], known: KnownStand, mounts: Sequence[Mounting]
) -> tuple[ErrorSource, ...]:
    """Return the sources of a stand's errors for readings in these mountings, as a calibration takes what is known.

    An angle of a mounting is a mean that others share and its own departure: `stated` sources keep their names for
    the latter, and the former, which hang together, are one source. Noise has its size in each channel.
    """
    return tuple(_sources(stated, known, mounts))


def _sources(
    stated: Sequence[ErrorSource], known: KnownStand, mounts: Sequence[Mounting]
) -> Iterator[ErrorSource]:
    labels = [mount.installation for mount in mounts]
    angles = [s for s in stated if s.name in STAND_ANGLES and s.u > 0]
    yield from _means(tuple(s.name for s in angles), known, labels)
    for source in stated:
        if source in angles:
            told = [known.place(source.name, label) is not None for label in labels]
            own = np.where(told, known.remount.get(source.name, 0.0), source.u)
            origin = f"{LEARNED}: what a remount adds"
            learned = replace(source, origin=origin, prior=False, dof=np.inf) if any(told) else source
            yield _with_root(learned, np.diag(own))
        elif known.noise is not None and source.name in ("voltmeter_error", "setting_error"):
            yield from _noise(source, known.noise)
        else:
            yield source


def _means(kinds: tuple[str, ...], known: KnownStand, labels: Sequence[str]) -> Iterator[ErrorSource]:
    """Yield the means of all kinds (draws by kind, then by mounting), of which mountings share one each."""
    size, axes = np.linalg.eigh(known.covariance)
    half = axes * np.sqrt(np.maximum(size, 0.0))
    places = [known.place(kind, label) for kind in kinds for label in labels]
    root = np.array([np.zeros(len(half)) if place is None else half[place] for place in places])
    if root.size and np.any(root):
        plain = ErrorSource(
            MEANS, "α mean", "rad", Distribution(1.0), "run", "stand", f"{LEARNED}: means of all mountings",
            angles=kinds,
        )  # fmt: skip
        yield _with_root(plain, root)


def _with_root(source: ErrorSource, root: Floats) -> ErrorSource:
    """Return a source whose draws are those of the root, SI: its u is what one of them has on the mean."""
    u = rms(np.sqrt(np.sum(root**2, axis=1)))
    return replace(
        source,
        distribution=Distribution(u),
        root=tuple(tuple(row) for row in (root / max(u, 1e-300)).tolist()),
    )


def _noise(source: ErrorSource, noise: KnownNoise) -> Iterator[ErrorSource]:
    if source.name == "setting_error":
        yield replace(
            source,
            distribution=Distribution(noise.setting_rad),
            dof=noise.setting_dof,
            origin=LEARNED,
            prior=False,
        )
        return
    for channel, size, dof in zip(CHANNELS, noise.channels.tolist(), noise.channel_dof.tolist(), strict=True):
        yield replace(
            source, name=f"{source.name}[{channel}]", distribution=Distribution(size), dof=dof, origin=LEARNED,
            prior=False, channels=(channel,),
        )  # fmt: skip
