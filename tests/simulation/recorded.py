"""Simulations for tests, and recorded trials in them."""

from equipoise import Settings, paper, shipped_pendulum
from equipoise.control.policy import KernelPolicy
from equipoise.model.actuator import IDEAL_ACTUATOR
from equipoise.model.random import TEST
from equipoise.simulation import Setup, TrialRecorder, run_trial
from equipoise.simulation.ideal import PlantSimulation


def on_the_plant(params, arm, pendulum, settings=None, seed=0, stream=TEST):
    task = shipped_pendulum(), arm, settings or Settings(), IDEAL_ACTUATOR, paper.STEP
    simulation = PlantSimulation("model", Setup(*task), seed=seed, stream=stream)
    simulation.params, simulation.pendulum = params, pendulum  # the latter for a loop's report
    return simulation


def run_all(simulation, kernel, trials, duration, workers=1, done=lambda rows: None):
    policy = KernelPolicy(kernel)
    simulation.run(policy, trials, duration=duration, workers=workers, done=done)
    return trials


def record(simulation, policy, trial, duration):
    """Run a trial from Python; return steps, cause and sum of x^2, and the record."""
    recorder = TrialRecorder()
    result = run_trial(simulation.loop(), policy, trial, duration, recorder)
    return result, recorder.rows
