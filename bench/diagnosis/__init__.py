"""Find where simulation and readings disagree, name the missing effect, add it, show how the gap shrinks.

Words of this package: a family is an effect of the catalogue or an unnamed pattern of residuals, and a variant is
one form of it. A family is missing if it acts in the readings and the model lacks it. A find is a family that the
search found missing. A tie is another family that explains the same readings. A plausible size is the typical
magnitude of a parameter of an effect. A free position is a position of unknown orientation at rest, of which only
|a| = 1 g is known. The setting error is that of the head angle phi. The noise ratio is the root mean square of the
signals that the setting error causes, divided by the noise of a reading.

Letters: n counts readings; N counts the rows of the linear system (three signals for each oriented reading, one for
each modulus |a|); P counts the columns of all candidates, and m those of the effects found. u is a standard
uncertainty, ln the natural logarithm, and du/dphi the derivative of the signals by phi.
"""

from bench.diagnosis.evidence import Threshold, ThresholdCache
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.result import Diagnosis, NamedEffect

__all__ = ["Diagnosis", "NamedEffect", "Threshold", "ThresholdCache", "diagnose"]
