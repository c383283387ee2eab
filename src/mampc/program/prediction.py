"""Prediction: the outputs over the horizon, as an affine function of the future moves and of the parameter.

With the step response S_i = D + sum_{k<i} C A^k B of the model

    y_i - y_op = free_i + sum_{j <= min(i, nc-1)} S_{i-j} du_j                                            i = 0..np
    free_i = C A^i x + S_i (u_prev - u_op + d_u) + S^v_i (v - v_op) + d_y            (no more moves)

with constant disturbances: d_u at the inputs, d_y at the outputs, and measured ones v with their own step
response S^v.
"""

from __future__ import annotations

import numpy as np

from mampc.base.errors import MampcError
from mampc.program.parameter import Parameter
from mampc.program.problem import TrackingProblem

LARGEST_RESPONSE = 1e100  # per unit of state or input; its square is still a number


class Prediction:
    """The outputs that a problem predicts; the module's docstring defines the symbols.

    Attributes:
        final_power: A^np, shape (n, n).
        step_response: S_0 .. S_np, shape (np + 1, l, m + d), measured disturbances behind the inputs.
        state_response: sum_{k<i} A^k B for i = 0..np, shape (np + 1, n, m + d).
        theta: outputs per move, lower block-triangular, shape ((np + 1) l, nc m).
        free: outputs without moves, from the operating point, a map of p of shape ((np + 1) l, parameter's size).

    Raises:
        MampcError: predictions that leave the numbers, of an unstable model.
    """

    def __init__(self, problem: TrackingProblem, parameter: Parameter) -> None:
        model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
        m, l = model.n_inputs, model.n_outputs
        power = [np.eye(model.n_states)]
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(n_p):
                power.append(power[-1] @ model.A)
            powers = np.array(power)
            observed = model.C @ powers
            none = np.zeros((1, *model.B.shape))
            self.state_response = np.cumsum(np.concatenate([none, powers[:-1] @ model.B]), axis=0)
        self.final_power = powers[-1]
        self.step_response = model.step_response(n_p + 1)
        for responses in (observed, self.step_response):
            if not (np.abs(responses) < LARGEST_RESPONSE).all():
                raise MampcError(
                    f"CondensedQP: expected predictions that stay within numbers over {n_p} samples, received "
                    "a model that grows without bound; shorten the prediction horizon"
                )
        self.theta = np.zeros(((n_p + 1) * l, n_c * m))
        for j in range(n_c):
            responses = self.step_response[: n_p + 1 - j, :, :m]
            self.theta[j * l :, j * m : (j + 1) * m] = responses.reshape(-1, m)

        of_all_inputs = self.step_response.reshape(-1, model.B.shape[1])
        self.free = free = parameter.no_map((n_p + 1) * l)
        free[:, parameter.x] = observed.reshape(len(free), model.n_states)
        free[:, parameter.u_deviation] = free[:, parameter.input_disturbance] = of_all_inputs[:, :m]
        free[:, parameter.measured_disturbance] = of_all_inputs[:, m:]
        free[:, parameter.output_disturbance] = np.tile(np.eye(l), (n_p + 1, 1))
