"""The report up to the trained policy: verdict, what this is, the free swing, the training."""

from collections.abc import Iterator
from importlib import resources

import numpy as np

from equipoise import paper
from equipoise.control.policy import TabularPolicy
from equipoise.evaluation import TrialResults
from equipoise.model.pendulum import Pendulum
from equipoise.model.sim_configs import MODEL
from equipoise.report.comparison import comparison
from equipoise.report.markup import (
    Missing,
    Part,
    Pictures,
    film,
    note,
    paragraph,
    part,
    picture,
    table,
    tiles,
    verdict_list,
)
from equipoise.report.pictures.film import SECONDS, Animation
from equipoise.studies.formatting import percent, plus_minus
from equipoise.studies.gap_results import CURED, at_world
from equipoise.studies.results import Results, verdict


def sections_training(
    results: Results, pictures: Pictures, animation: Animation | Missing
) -> Iterator[Part]:
    """Return the sections up to the training."""
    yield _verdict(results)
    yield _what_this_is(results, animation)
    yield part(
        "paper",
        "Paper and here",
        table(("", "section", "the paper", "here"), comparison(results)),
    )
    yield _swing(results, pictures)
    yield _training(results, pictures)


def _verdict(results: Results) -> Part:
    trials, evaluation = results.evaluation.results, results.evaluation
    standing = [
        _stood(trials, evaluation.duration, "the plant of the training"),
        (
            f"{results.run.lasted:.3g} s",
            f"the recorded run stood, of {results.run.conditions.duration:g} s at most, on "
            f"{_where(results)}",
        ),
    ]
    if results.run.conditions.world != MODEL:
        standing.reverse()  # the twin first: it is nearer to the paper's robot
    if gap := results.gap:
        twin = f"the digital twin {gap.world}"
        standing.insert(0, _stood(at_world(gap, CURED), gap.duration, twin))
    paper_run = f"{paper.SECONDS_BALANCED:g} s", "the paper's run stood, on the real arm, once"
    return part("verdict", "Verdict", tiles(*standing, paper_run), verdict_list(verdict(results)))


def _stood(trials: TrialResults, duration: float, where: str) -> tuple[str, str]:
    summary = trials.summary()
    low, high = summary.interval
    return (
        f"{summary.survived} of {summary.trials}",
        f"trials stood {duration:g} s on {where}; 95 % interval of the chance {percent(low)} to "
        f"{percent(high)}",
    )


def _where(results: Results) -> str:
    world = results.run.conditions.world
    return "that plant" if world == MODEL else f"the digital twin {world}"


def _what_this_is(results: Results, animation: Animation | Missing) -> Part:
    fall = 1.0 / np.sqrt(results.pendulum.w2.value)
    sketch = resources.files("equipoise.report").joinpath("sketch.svg").read_text(encoding="utf-8")
    return part(
        "what",
        "What this is",
        paragraph(
            "A pendulum is mounted on the flange of a robot arm. It turns freely on its pivot, and "
            "the arm is to keep it upright by moving the flange to and fro along one line. That is "
            f"hard: left alone, the pendulum's lean grows almost threefold every {fall:.3f} s, and "
            f"the arm may go {paper.X_LIMIT:g} m to either side and no further."
        ),
        film(
            animation,
            f"The first {_shown(results)} of the recorded run, at their real speed. The posts "
            f"stand at x = ±{paper.X_LIMIT:g} m, the marks between them every 0.1 m; the shadow of "
            "the pivot shows x. The arrow is the commanded acceleration u.",
            "Moving pictures of the arm balancing the pendulum between the ends of the track",
        ),
        f"<figure>{sketch}<figcaption>The state is s = (x, dx/dt, φ, dφ/dt): where the flange is, "
        "how fast it moves, how far the pendulum leans, how fast it falls. The command is u. "
        f"The attempt has failed when |φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches "
        f"{paper.X_LIMIT:g} m.</figcaption></figure>\n",
        paragraph(
            "The paper lets the arm learn this with one of the oldest methods there is: a table. "
            f"The state is cut into {len(results.policy.Q)} boxes, and for each box the table "
            f"holds how good each of {len(paper.ACTIONS)} accelerations is. Trial and error in "
            "simulation fills the table (Q-learning); then, a hundred times a second, the box of "
            "the state is looked up and its best acceleration is commanded."
        ),
        *map(paragraph, _what_was_added(results)),
        paragraph(
            "This page goes the same way: a free swing tells the pendulum's parameters, a "
            "simulated arm learns with such a pendulum, the table is put to the test against "
            f"pendulums it has not met, and one run is recorded, on {_stage(results)}."
        ),
    )


def _shown(results: Results) -> str:
    return f"{min(results.run.lasted, SECONDS):g} s"


def _stage(results: Results) -> str:
    if results.run.conditions.world == MODEL:
        return "the plant of the training"
    return "a digital twin of the robot, where the paper's was on the robot itself"


def _what_was_added(results: Results) -> Iterator[str]:
    if results.policy.settings.plant.ideal:
        return
    yield (
        "A robot adds what the paper's simulation does not have. A command takes effect some time "
        "after it was sent, and meanwhile the pendulum falls on; and the encoder's zero may be "
        "wrong, so that upright is not where it seems to be. So here a controller stands between "
        "sensor and table: it estimates angle, rate and the error of the zero, and predicts the "
        "state at the moment when the command will act. The table sees that state. It is trained "
        "behind the same controller, on an arm that lags as an identification of the twin says."
    )


def _swing(results: Results, pictures: Pictures) -> Part:
    pendulum, fit, simulated = results.pendulum, results.pendulum.fit, results.record.simulated
    given = (
        "No recording was given, so one was simulated, with the encoder's steps, some vibration "
        "and a hand that holds the pendulum first; the last column is what was simulated."
        if simulated
        else f"The recording is `{results.record.swing}`."
    )
    warnings = "".join(note(warning) for warning in (fit.warnings if fit else ()))
    return part(
        "swing",
        "The free swing and what it tells",
        paragraph(
            "The pendulum hangs, is lifted, let go, and swings; an encoder on its spindle records "
            "the angle θ from hanging. It swings as I θ'' + b θ' + m g l sin θ = 0 says (the "
            f"paper's equation 8). Fitting that gives w2 = m g l / I and c = b / I, and with "
            f"gravity the coupling k = m l / I. Control needs nothing else. {given}"
        ),
        picture(
            pictures,
            "figure-2-free-swing",
            "The paper's figure 2. Where recording and fit cannot be told apart, look at what is "
            "left, below. The grey part, with a hand on the pendulum, was found and left out.",
            "Recorded angle of the swinging pendulum with the fitted curve on it, and the residual",
        ),
        _estimates(pendulum, results),
        warnings,
    )


def _estimates(pendulum: Pendulum, results: Results) -> str:
    truth = {}
    if swing := results.record.simulated:
        w2 = (2.0 * np.pi / swing.period) ** 2
        truth = {"w2": w2, "k": w2 / pendulum.g, "c": swing.c}
    rows = [
        ("w2 = m g l / I", "1/s²", pendulum.w2, truth.get("w2")),
        ("k = m l / I", "1/m", pendulum.k, truth.get("k")),
        ("c = b / I", "1/s", pendulum.c, truth.get("c")),
    ]
    if pendulum.friction_model != "viscous":
        rows.append(("Coulomb friction / I", "1/s²", pendulum.coulomb, None))
    if pendulum.friction_model == "quadratic":
        rows.append(("quadratic drag / I", "1/rad", pendulum.drag, None))
    if pendulum.inertia and pendulum.friction:
        rows.append(("I", "kg m²", pendulum.inertia, None))
        rows.append(("b", "N m s", pendulum.friction, None))
    head = ["", "unit", "identified, ± half of the 95 % interval"]
    return table(
        [*head, "simulated"] if truth else head,
        [
            [name, unit, plus_minus(e.value, e.interval), *([f"{true:.6g}"] if true else [])]
            for name, unit, e, true in rows
        ],
        numbers=2 if truth else 1,
    )


def _candidate(policy: TabularPolicy) -> str:
    if policy.settings.selection.averaging == 1.0:
        return "the table of the moment"
    return "a running average of the table"


def _actuator(policy: TabularPolicy) -> str:
    actuator, plant = policy.actuator, policy.settings.plant
    if plant.ideal:
        return (
            "The arm is where it is sent, at once, and the state is known without a sensor, as in "
            "the paper's simulation."
        )
    lags = [1e3 * lag.value for lag in actuator.lags]
    law = {"kst": "through the server's shaping law, ", "lag": "", "ideal": ""}[actuator.kind]
    return (
        f"The arm follows its setpoints after {1e3 * actuator.delay.value:.1f} ms, {law}with lags "
        f"of {min(lags):.1f} to {max(lags):.1f} ms in its joints. These numbers come from "
        "`equipoise identify`, out of a log of the moving arm, never from the settings of the "
        "twin. In each episode they are a little wrong, and so is the encoder's zero: the policy "
        "learns behind estimator and prediction, with their errors."
    )


def _training(results: Results, pictures: Pictures) -> Part:
    policy, s = results.policy, results.policy.settings
    reach = s.learning.start_x
    where = f"anywhere within {reach:g} m of the middle" if reach else "in the middle"
    texts = [
        f"An episode starts with the flange {where} and the pendulum leaning up to "
        f"{np.rad2deg(s.learning.start_phi):.3g}°. Every {policy.h:g} s an "
        "acceleration is chosen and becomes joint motion by closed-loop inverse kinematics (the "
        "paper's equation 3); what the flange really does drives the pendulum (equation 7"
        f"{'' if s.plant.linearised else ', with its sines'}). The episode ends with a failure or "
        f"after {s.learning.episode_duration:g} s. A failure costs {-s.learning.reward_failure:g}, "
        "everything else nothing, and equation 1 carries that back to the choices before it. Each "
        "episode has another I and b, each step noise on the pose error, as in the paper.",
        _actuator(policy),
    ]
    if policy.checkpoints:
        chosen, selection = policy.checkpoints[0], s.selection
        texts.append(
            "The table changes until the last episode, and a later one is not always better. So "
            f"after every {selection.every} episodes {_candidate(policy)} runs "
            f"{selection.screening_trials} trials of {selection.duration:g} s, on plants that vary "
            f"{selection.spread:g} times as much as those of the training; the best "
            f"{selection.finalists} run {selection.final_trials} more of "
            f"{selection.final_duration:g} s. The table after episode "
            f"{chosen.episodes:,} was kept: it stood in {chosen.survived} of {chosen.trials}. None "
            "of these trials is used again below."
        )
    else:
        texts.append("The table after the last episode is the policy: nothing was selected.")
    return part(
        "training",
        "Training",
        *map(paragraph, texts),
        picture(
            pictures,
            "learning-curve",
            "Above, what the learner went through, exploration included. Below, what the table of "
            "each moment can do when it is frozen: one other choice in one box can make or break "
            "it, which is why the best is kept and not the last.",
            "Mean duration of the training episodes and survival of the greedy policy",
        ),
    )
