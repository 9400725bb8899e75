"""Logs of runs: one MCAP schema, one writer and one reader, for simulated runs and runs on a rig.

::

    tick loop -> Recorder (rings) -> RunWriter (file, during the run) -+
                                                                              +-> MCAP -> RunLog
    simulation -> RunLog.simulated -> RunLog.save (file, atomically) +

`layout` defines the tables and their columns, `conditions` the conditions and the end of a run.
`writer` and `container` write and read the file; `foxglove` adds messages for the 3D panels of
Foxglove and Lichtblick.
"""
