"""Logs of runs: one MCAP schema, one writer and one reader, for simulated runs and runs on a rig.

::

    tick loop -> Recorder (rings) -> RunWriter (file, during the run) -+
                                                                       +-> MCAP -> RunLog
    simulation -> simulated_log -> RunLog.save (file, atomically) --+

`columns` describes the tables once; everything here follows from it. `conditions` holds the
conditions and the end of a run.
"""
