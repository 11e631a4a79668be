"""Find where simulation and readings disagree, name the missing effect, add it, show how the gap shrinks.

Words and letters of this package: a family is an effect of the catalogue or an unnamed pattern of residuals,
a variant is one form of it. A plausible size is the size that a parameter of an effect typically has. A tie
is another family that explains the same readings. n counts readings, N the rows of the linear system (three
signals for each oriented reading, one for each modulus |a|), P the columns of all candidates, m those of the
effects found; u is a standard uncertainty, ln the natural logarithm. "Setting error" is that of the head
angle phi, du/dphi the derivative of the signals by it. The noise ratio is the root mean square of the signals
of the setting error over the noise of a reading.
"""

from bench.diagnosis.evidence import Threshold, ThresholdCache
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.result import Diagnosis, NamedEffect

__all__ = ["Diagnosis", "NamedEffect", "Threshold", "ThresholdCache", "diagnose"]
