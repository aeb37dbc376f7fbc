"""A control loop at a fixed rate: the tip follows a moving point, one certified step a cycle."""

import time

import numpy as np

import vgtm_qp as vq

RATE = 25.0
CYCLES = 75

resolver = vq.Resolver(vq.load_problem("five_bay_two_cubes"))
start = resolver.tip()[0]

late = 0
computing = []
begun = time.perf_counter()
for cycle in range(1, CYCLES + 1):
    angle = 2.0 * np.pi * cycle / CYCLES
    swing = np.array([np.sin(angle), 1.0 - np.cos(angle), np.cos(angle) - 1.0])
    goal = start + np.array([0.15, 0.15, 0.1]) * swing

    clock = time.perf_counter()
    step = resolver.step(position=goal, dt=1.0 / RATE)
    computing.append(time.perf_counter() - clock)

    # Here step.state.quantities go to the actuators, in the order of resolver.setup.arm.quantity_names.
    if step.status is not vq.StepStatus.REACHED:
        print(f"cycle {cycle}: {step.status}, {step.progress:.0%} of the way; held by {step.blocked_by[:2]}")

    wait = begun + cycle / RATE - time.perf_counter()
    late += wait < 0.0
    time.sleep(max(0.0, wait))

gap = float(np.linalg.norm(resolver.tip()[0] - goal))
print(f"{CYCLES} cycles at {RATE:g} Hz, {late} late; median of a step {1000 * np.median(computing):.2f} ms")
print(f"the tip is {1000 * gap:.3f} mm from its goal")
