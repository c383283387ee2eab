"""The closed loop: estimator, sensor and actuator checks, regulator, simulation, replay."""
