"""Figures and the page: drawn from saved artefacts and values, by nobody else's help."""
