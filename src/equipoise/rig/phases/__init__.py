r"""Phases of a run on a rig, one class each, and what they share.

::

    Homing -> Confirming -> Referencing -> SelfTesting -> Lifting -> Balancing
                                 ^          |       |        ^
                                 +-- zero --+       +-> Exciting

A stop leads from each of them to `Stopping`, which is latched: nothing leads out of it, and the
first cause is kept; only a new run begins anew.
"""
