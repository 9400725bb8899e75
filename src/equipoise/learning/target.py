"""Training of learners until a policy meets a target in trials that did not select it."""

from typing import Annotated, Final

from pydantic import Field

from equipoise.arguments import Workers, checked
from equipoise.artefacts import Seed, Share, StrPath
from equipoise.control.policy import TabularPolicy, TargetTest
from equipoise.errors import InputError
from equipoise.executors import Show, running
from equipoise.learning.select import (
    ERROR,
    Running,
    measure_share,
    trials_to_meet,
)
from equipoise.learning.train import check_task, stage_of, train
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import read_arm
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.model.random import TARGET_TEST
from equipoise.model.worlds import MODEL
from equipoise.settings import Settings
from equipoise.worlds import setup_of
from equipoise.worlds.ideal import PlantSimulation

LEARNERS: Final = 6
"""Maximum number of learners of a training by default."""
TARGET: Final = 0.99
"""Required share of trials that last, by default [-]."""


@checked
def train_to_target(
    pendulum: Pendulum | StrPath | None = None,
    arm: Arm | StrPath | None = None,
    settings: Settings | None = None,
    *,
    target: Share = TARGET,
    learners: Annotated[int, Field(ge=1)] = LEARNERS,
    actuator: Actuator | StrPath | None = None,
    world: str = MODEL,
    seed: Seed = 0,
    workers: Workers = 1,
    show: Show = lambda *_: None,
) -> TabularPolicy:
    """Train learners of one seed, one after the other, until one meets a target.

    A policy below the target is accepted with a probability of at most 5 %, over all learners.

    Args:
        pendulum: The identified pendulum; as in `train`.
        arm: The arm; as in `train`.
        settings: Resolved settings; as in `train`.
        target: Share of trials that a policy has to last: the lower end of its interval.
        learners: Maximum number of learners.
        actuator: Actuator of the arm; as in `train`.
        world: World of the episodes; as in `train`.
        seed: Master seed.
        workers: Number of threads of the trials; the result does not depend on it.
        show: Called with the progress of the stages `train`, `select` and `test`.

    Returns:
        The tested policy of the first learner that meets the target; if none meets it, the one with
        the highest lower end of the interval.

    Raises:
        InputError: The test has too few trials for the target, even without a failure.
        SettingsError: No controller saves as many of the releases as the target needs.
    """
    pendulum, arm, settings = read_pendulum(pendulum), read_arm(arm), settings or Settings()
    most = settings.selection.test_trials
    if trials_to_meet(target, _error(0), 0, 0, most) is None:
        raise InputError(
            f"{most:,} trials cannot show a share of {target:g}, even without a failure; lower "
            "--target, or raise selection.test_trials"
        )
    check_task(pendulum, settings, actuator, world=world, target=target)
    tested: list[TabularPolicy] = []
    for learner in range(learners):
        policy = train(
            pendulum,
            arm,
            settings,
            actuator=actuator,
            world=world,
            seed=seed,
            learner=learner,
            workers=workers,
            show=show,
        )
        test = measure_policy(
            policy,
            target=target,
            error=_error(learner),
            workers=workers,
            running=running(stage_of("test", learner), show),
        )
        tested.append(policy.model_copy(update={"test": test}))
        if not tested[-1].shortfall:
            break
    return max(tested, key=_rank)


def _rank(policy: TabularPolicy) -> tuple[bool, float, float]:
    """Return the sort key of a tested policy; the highest one is the best."""
    low = 0.0 if policy.test is None else policy.test.interval[0]
    return not policy.shortfall, low, policy.checkpoints[0].score if policy.checkpoints else 0.0


def _error(learner: int) -> float:
    """Return the error of the test of a learner; the sum over all learners is `ERROR`."""
    return ERROR / ((learner + 1) * (learner + 2))


def measure_policy(
    policy: TabularPolicy,
    *,
    target: float = TARGET,
    error: float = ERROR,
    workers: int = 1,
    running: Running = lambda _, __: None,
) -> TargetTest:
    """Test a policy on the plant of its training; see `equipoise.learning.select.measure_share`."""
    setup = setup_of(policy, MODEL)
    simulation = PlantSimulation(MODEL, setup, seed=policy.seed, stream=TARGET_TEST)
    return measure_share(
        simulation, policy.u_of_box, target=target, error=error, workers=workers, running=running
    )
