"""Figures and the HTML report, drawn from saved artefacts and values."""
