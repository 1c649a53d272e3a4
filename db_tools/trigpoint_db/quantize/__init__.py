"""A float feature network made INT8, if little is lost by it."""

from trigpoint_db.quantize.comparison import Comparison, Score
from trigpoint_db.quantize.report import QuantizationReport
from trigpoint_db.quantize.run import QuantizationOptions, quantize

__all__ = ["Comparison", "QuantizationOptions", "QuantizationReport", "Score", "quantize"]
