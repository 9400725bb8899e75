"""MuJoCo is imported once, whichever thread is first."""

import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from equipoise import physics_engine


def test_threads_that_begin_together_import_it_once(monkeypatch):
    imports = []

    def import_slowly(name):
        imports.append(name)
        time.sleep(0.05)  # the others come meanwhile
        return SimpleNamespace(set_mju_user_warning=lambda handler: None)

    monkeypatch.setattr(physics_engine, "import_module", import_slowly)
    physics_engine.import_mujoco.cache_clear()
    try:
        with ThreadPoolExecutor(4) as threads:
            modules = list(threads.map(lambda _: physics_engine.mujoco(), range(4)))
    finally:
        physics_engine.import_mujoco.cache_clear()
    assert imports == ["mujoco"]
    assert all(module is modules[0] for module in modules)
