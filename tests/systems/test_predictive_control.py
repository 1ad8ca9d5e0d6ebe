"""Predictive controllers of other packages that follow a plan by `reference_window`: runnable examples."""

import warnings

import control as ct
import control.optimal as opt
import numpy as np
import pytest

pytest.importorskip("casadi")

from flat_plants import car

import ctrlplan as cp

CAR = cp.flat_system(car, ["x", "y"], at={"v": 1.0})
LANE = cp.PolySpline(
    [cp.Waypoint.from_jets(0.0, x=[0, 10, 0], y=[0, 0, 0]), cp.Waypoint.from_jets(4.0, x=[40, 10, 0], y=[3.5, 0, 0])]
)
STEP, COUNT = 0.1, 8
Q, R = np.diag([1.0, 1.0, 10.0]), np.diag([1.0, 10.0])
OFF = np.array([0.0, 0.3, 0.0])
"""The car starts 0.3 m off its lane."""


def moved(x, u):
    """State of the car after one step with a constant input."""
    found = cp.simulate(car, [0.0, STEP], np.tile(np.asarray(u, dtype=float)[:, None], 2), x)
    return found.states[:, -1]


@pytest.mark.slow
def test_optimal_control_of_python_control():
    """Its costs depend on states and inputs only: a state t' = 1 selects the reference."""
    clocked = ct.nlsys(
        lambda t, x, u, p: [*car.updfcn(t, x[:3], u, p), 1.0],
        None,
        states=["x", "y", "th", "t"],
        inputs=car.input_labels,
        outputs=4,
        name="clocked_car",
    )

    def input_at(time, x):
        states, inputs = cp.reference_window(LANE, time, STEP, COUNT, flat=CAR)

        times = STEP * np.arange(COUNT + 1)

        def cost(z, u):
            k = round(min(max((z[3] - time) / STEP, 0.0), COUNT - 1.0))
            return (z[:3] - states[:, k]) @ Q @ (z[:3] - states[:, k]) + (u - inputs[:, k]) @ R @ (u - inputs[:, k])

        found = opt.solve_ocp(
            clocked,
            times,
            [*x, time],
            cost,
            terminal_cost=lambda z, u: (z[:3] - states[:, -1]) @ Q @ (z[:3] - states[:, -1]),
            initial_guess=(np.vstack([states, times + time]), np.column_stack([inputs, inputs[:, -1]])),
            print_summary=False,
            minimize_method="SLSQP",
        )
        assert found.success
        return found.inputs[:, 0]

    x = LANE_START + OFF
    for k in range(10):
        x = moved(x, input_at(STEP * k, x))
    wanted, _ = cp.reference_window(LANE, 10 * STEP, STEP, 1, flat=CAR)
    assert np.hypot(*(x - wanted[:, 0])[:2]) < 0.05


LANE_START = CAR.states_and_inputs(LANE, 0.0)[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_do_mpc():
    """The window becomes its time-varying parameters."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of optional dependencies that are missing
        do_mpc = pytest.importorskip("do_mpc")
    import casadi as ca

    model = do_mpc.model.Model("continuous")
    x = model.set_variable("_x", "x", (3, 1))
    u = model.set_variable("_u", "u", (2, 1))
    wanted = model.set_variable("_tvp", "wanted", (3, 1))
    known = model.set_variable("_tvp", "known", (2, 1))
    model.set_rhs("x", ca.vertcat(u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[0] * ca.tan(u[1]) / 3.0))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mpc.set_param(n_horizon=COUNT, t_step=STEP, store_full_solution=False)
        mpc.settings.supress_ipopt_output()
    error, feedback = x - wanted, u - known
    last = ca.bilin(ca.DM(Q), error, error)
    mpc.set_objective(mterm=last, lterm=last + ca.bilin(ca.DM(R), feedback, feedback))
    mpc.set_rterm(u=0.0)
    template = mpc.get_tvp_template()

    def window(time):
        states, inputs = cp.reference_window(LANE, float(np.squeeze(time)), STEP, COUNT, flat=CAR)
        for k in range(COUNT + 1):
            template["_tvp", k, "wanted"] = states[:, k]
            template["_tvp", k, "known"] = inputs[:, min(k, COUNT - 1)]
        return template

    mpc.set_tvp_fun(window)
    mpc.setup()
    state = LANE_START + OFF
    mpc.x0 = state
    mpc.set_initial_guess()
    for _ in range(10):
        state = moved(state, mpc.make_step(state[:, None]).ravel())
    states, _ = cp.reference_window(LANE, 10 * STEP, STEP, 1, flat=CAR)
    assert np.hypot(*(state - states[:, 0])[:2]) < 0.05
