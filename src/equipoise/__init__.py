"""Equipoise teaches a robot arm to balance an inverted pendulum.

Identify, train, evaluate, deploy.

This module provides the public names, which `__init__.pyi` lists. The first use of a name imports
its module, so that `import equipoise` costs nothing. Values are immutable, units are SI and
radians::

    Trajectory -> identify -> Pendulum -> train -> TabularPolicy -> evaluate -> Evaluation
    excite -> RunLog -> identify_run -> Actuator ---^            `-> simulate_run -> RunLog
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.1.0"
