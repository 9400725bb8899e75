"""Find the delay and the servo of an arm in the log of its motion.

python examples/delay_of_a_log.py [log.mcap]

The log is that of `equipoise deploy --excite`, of a robot or, as here, of its twin.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import equipoise as eq

run = eq.RunLog.load(sys.argv[1]) if len(sys.argv) > 1 else eq.excite(world="twin:nominal")
actuator = eq.identify_run(run)
delay = actuator.delay
print(
    f"a setpoint acts after {1e3 * delay.value:.1f} ms "
    f"(95 %: {1e3 * delay.low:.1f} to {1e3 * delay.high:.1f} ms), by the law {actuator.kind}"
)

JOINT = 0
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for name, rows in (("sent", run.stream), ("measured", run.replies)):
    axes.plot(rows["time"], np.degrees(rows["q"][:, JOINT]), label=name)
axes.set(xlim=(3.0, 4.0), xlabel="time [s]", ylabel=f"joint {JOINT + 1} [deg]")
axes.legend()
figure.savefig("delay_of_a_log.png")
