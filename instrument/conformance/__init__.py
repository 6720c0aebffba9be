"""Conformance: `check(obj)` holds anyone's plugin to the contract of its kind, and says what does not hold."""

from instrument.conformance.checking import Line, Report, check

__all__ = ["Line", "Report", "check"]
