"""Logs of runs: one MCAP schema, one writer and one reader, for simulated runs and runs on a rig.

::

    tick loop -> Recorder (rings) -> RunWriter (file, while the run goes on) -+
                                                                              +-> MCAP -> RunLog
    simulation -> RunLog.simulated -> RunLog.save (file, whole or not at all) +

`layout` lists the tables and their columns, `conditions` the facts that hold for a whole run.
`writer` and `container` write and read the file, `foxglove` adds the messages that Foxglove and
Lichtblick draw.
"""
