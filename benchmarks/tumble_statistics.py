"""Test the uncertainties of a tumble's terms on simulated turns with known K2, K3, K_oq.

    python -m benchmarks.tumble_statistics --runs 300

For turns of 8, 12 and 24 points it prints the root mean square of (estimate - truth)/u of every quantity of every
axis. Stand, terms and noise are drawn for each run; u is that of the readings (promised: 0.9 to 1.1, with a
margin of three standard errors). With 8 points, some estimates are sums of terms; their truth is the sum that the
result states. The simulation shares no geometry and no term with the model. The exit status is 1 if a promise is
broken.
"""

import sys

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.tumble import TumbleView, tumble_view
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import STAND_U
from benchmarks.campaign import arguments
from tests.support.tumble_bench import Terms, truth, tumble

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
POINTS = (8, 12, 24)


def z_of(view: TumbleView, terms: Terms) -> Floats:
    alone, scores = truth(terms), []
    for channel, own in view.axes.items():
        for q in own:
            value = alone[f"{channel}.{q.name}"]
            parts = sum(share * alone[f"{channel}.{term}"] for term, share in q.contains.items())
            true = value * (1 + parts) if q.name == "K1" else value + parts
            scores.append((q.value - true) / q.u)
    return np.array(scores)


def main() -> int:
    asked = arguments(__doc__, runs=300, noise=0.0001, seed=1)
    broken = 0
    width = 3 / np.sqrt(2 * asked.runs)
    for points in POINTS:
        rows, names, fits = [], [], []
        for rng in np.random.default_rng([asked.seed, points]).spawn(asked.runs):
            terms = Terms.drawn(rng)
            view = tumble_view(tumble(rng, asked.noise, terms, points=points), MODEL, STAND_U, 9.81)
            rows.append(z_of(view, terms))
            fits.append(view.lack_of_fit.p)
            names = view.names
        z = np.sqrt(np.mean(np.array(rows) ** 2, axis=0))
        order = np.argsort(z)
        p = np.array(fits)
        print(
            f"{points} points, {asked.runs} runs, {len(names)} quantities: rms of all {np.sqrt(np.mean(z**2)):.3f}"
        )
        print(f"  least {names[order[0]]} {z[order[0]]:.3f}, most {names[order[-1]]} {z[order[-1]]:.3f}")
        print(f"  lack of fit, p below 0.01: {np.mean(p < 0.01):.3f}, below 0.5: {np.mean(p < 0.5):.3f}")
        broken += int(np.sum((z < 0.9 - width) | (z > 1.1 + width)))
    print(f"outside 0.9 to 1.1 (and {width:.2f}): {broken}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
