"""Live view of a rig in the browser, and the operator's console of a run.

`scene` draws arm and pendulum in 3-D with viser, from the geometry of the still pictures. viser is
an optional dependency, the extra `console`; it is imported where it is used.
"""
