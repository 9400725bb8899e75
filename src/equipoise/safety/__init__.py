"""Safety: rules, limits and stop motion, readable without the rest."""
