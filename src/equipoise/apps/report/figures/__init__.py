"""Figures of the paper and of the report, drawn from saved values only.

Every function returns a matplotlib figure; `report.style.save` writes it as SVG and PNG.
"""

from equipoise.apps.report.figures.free_swing import free_swing, predicted_swing
from equipoise.apps.report.figures.learning_curve import learning_curve
from equipoise.apps.report.figures.run import commands, encoder_zero, flange, joints, pendulum
from equipoise.apps.report.figures.survival import survival
from equipoise.apps.report.figures.table import policy_picture

__all__ = ["commands", "encoder_zero", "flange", "joints", "pendulum"]
__all__ += ["free_swing", "learning_curve", "policy_picture", "predicted_swing", "survival"]
