"""Algorithms as one reads them: a dictionary of boxes, one episode after the other in a list.

The loop of `equipoise.learning.episodes` must equal it. Both
share the compiled plant (`reset`, `draw_noise`, `step`) and the random words; boxes, table, mirror,
rewards, learning rules, exploration and the order of events are written here a second time. Every
episode has a batch of its own and is alone in it.

The rules that the paper leaves open: 16 episodes run side by side, in step; each acts by the table
as it stands before the step; then they update it, the last one first. An episode that ends gives
its place to the next, or, where none is left, to the last of those that run.
"""

from math import radians
from typing import NamedTuple

import numpy as np

from equipoise import PendulumParameters, paper
from equipoise.model import random
from equipoise.model.grid import TRUNCATED
from equipoise.simulation.plant import DomainRandomization, draw_noise
from tests.batch import Batch
from tests.reference.intervals import place

SIDE_BY_SIDE = 16


class Result(NamedTuple):
    """What a training comes to, in the order of the code's own arrays."""

    Q: np.ndarray
    visits: np.ndarray
    begun: int
    ended: int
    steps: int


class Episode:
    """One episode on a plant of its own."""

    def __init__(self, plant, pendulum, settings, seed, number):
        """Draw the pendulum, the rig and the start."""
        self.seed, self.number, self.tick, self.block = seed, number, 0, Batch(plant)
        w0, w1, _, _ = random.philox(seed, 0, number, 0, random.TRAINING_EPISODE)
        on_I, on_b = random.normal_pair(w0, w1)
        I = max(0.1, 1.0 + settings.plant.inertia_sigma * on_I)
        b = max(0.0, 1.0 + settings.plant.friction_sigma * on_b)
        s = settings.learning
        words = random.philox(seed, 0, number, 0, random.TRAINING_START)
        widths = (s.start_x, s.start_x_dot, s.start_phi, s.start_phi_dot)
        start = tuple(random.uniform(w, -most, most) for w, most in zip(words, widths, strict=True))
        # w2 = m g l / I, k = m l / I, c = b / I.
        own = PendulumParameters(
            w2=pendulum.w2 / I,
            k=pendulum.k / I,
            c=pendulum.c * b / I,
            coulomb=pendulum.coulomb / I,
            drag=pendulum.drag / I,
            linearised=pendulum.linearised,
        )
        rig = settings.plant
        w0, w1, w2, _ = random.philox(seed, 0, number, 0, random.TRAINING_ACTUATOR)
        variation = DomainRandomization(
            inertia_factor=1.0,  # the pendulum has them already
            friction_factor=1.0,
            delay=random.uniform(w0, -rig.delay_spread, rig.delay_spread),
            lag_factor=random.uniform(w1, 1.0 - rig.lag_spread, 1.0 + rig.lag_spread),
            zero=random.uniform(w2, -rig.zero_error, rig.zero_error),
        )
        self.block.reset(own, variation, start)
        self.look_ahead, self.length = settings.boxes.look_ahead, 1.0 / pendulum.k
        self.cell = self.place()
        self.action = -1

    def observation(self):
        """Return what the policy sees."""
        return self.block.observation(0).tolist()

    def place(self):
        """Return the intervals (i, j, k, m) that hold what the policy sees."""
        x, x_dot, phi, phi_dot = self.observation()
        x += self.look_ahead * (x_dot + self.length * phi_dot)
        # A prediction may lie beyond the limits, where no box is: it counts as just within.
        x, phi = min(max(x, -0.2199), 0.2199), min(max(phi, -0.1919), 0.1919)
        return place(x, x_dot, phi, phi_dot)

    def advance(self):
        """Make one control step with its action; tell whether it failed."""
        tick, number = [self.tick], [self.number]
        draw_noise(self.block.controller.noise, self.seed, tick, number, random.TRAINING_NOISE, 1)
        self.block.controller.u[0] = paper.ACTIONS[self.action]
        self.block.step()
        self.tick += 1
        return self.block.state.cause[0] != TRUNCATED


REWARDS = {
    "failure": lambda x, phi, failed: -1.0 * failed,
    "alive": lambda x, phi, failed: 1.0 - failed,
    # At the end of the track, or at 11 degrees, a step costs a hundredth of a failure.
    "centred": lambda x, phi, failed: (
        -1.0 if failed else -0.01 * ((x / 0.22) ** 2 + (phi / radians(11.0)) ** 2)
    ),
}


def train(plant, pendulum, settings, until, seed):
    """Return the table after `until` episodes have ended."""
    s = settings.learning
    reward = REWARDS[s.reward]
    Q = {cell: [0.0] * 8 for cell in np.ndindex(6, 5, 3, 3)}
    visits = {cell: [0] * 8 for cell in Q}
    begun = ended = steps = 0
    longest = round(s.episode_duration / 0.01)

    def begin():
        nonlocal begun
        begun += 1
        return Episode(plant, pendulum, settings, seed, begun - 1)

    def choose(episode):
        w0, w1, _, _ = random.philox(seed, episode.tick, episode.number, 0, random.TRAINING_ACTION)
        epsilon = s.epsilon_initial
        if s.epsilon_until > 0.0:
            epsilon *= max(0.0, 1.0 - episode.number / (s.epsilon_until * s.episodes))
        if w0 / 2**32 < epsilon:
            return w1 * 8 >> 32
        values = Q[episode.cell]
        best = [action for action in range(8) if values[action] == max(values)]
        return best[w1 * len(best) >> 32]

    def alpha(cell, action):
        N = visits[cell][action]
        return max(s.alpha_initial / (1.0 + s.alpha_decay * N), s.alpha_minimum)

    def mirror(table, cell, action):
        if s.mirrored:
            i, j, k, m = cell
            table[5 - i, 4 - j, 2 - k, 2 - m][7 - action] = table[cell][action]

    def learn(episode, cell, action, r, failed):
        """Apply equation (1); the episode is in its next cell."""
        target = r
        if not failed:
            target += s.gamma * max(Q[episode.cell])
        a = alpha(cell, action)
        Q[cell][action] = (1.0 - a) * Q[cell][action] + a * target
        mirror(Q, cell, action)
        visits[cell][action] += 1
        mirror(visits, cell, action)

    running = [begin() for _ in range(min(SIDE_BY_SIDE, s.episodes))]
    while ended < until:
        for episode in running:
            episode.action = int(choose(episode))
        failed = [episode.advance() for episode in running]
        steps += len(running)
        for n in reversed(range(len(running))):
            episode = running[n]
            x, _, phi, _ = episode.observation()
            r = reward(x, phi, failed[n])
            over = failed[n] or episode.tick >= longest
            cell, action = episode.cell, episode.action
            if not failed[n]:
                episode.cell = episode.place()
            learn(episode, cell, action, r, failed[n])
            if not over:
                continue
            ended += 1
            if begun < s.episodes:
                running[n] = begin()
            else:
                running[n] = running[-1]
                running.pop()
    return Result(np.array(list(Q.values())), np.array(list(visits.values())), begun, ended, steps)
