"""`compare` and `sweep` with the arguments of 0.1, which work for one release with a notice; remove with 0.3."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import Any, ParamSpec, TypeAlias, TypeVar

from ctrlplan._renamed import warn_renamed
from ctrlplan.studies import comparison as _comparison
from ctrlplan.studies import sweep as _sweep
from ctrlplan.studies.benefit import Choices, benefit_of
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.measures import MEASURES, Function, Measure, Run, checked_names
from ctrlplan.studies.monte_carlo import monte_carlo
from ctrlplan.studies.plans import standard_plans, waypoints_given
from ctrlplan.trajectories import TrigSpline

P = ParamSpec("P")
R = TypeVar("R")
Given: TypeAlias = dict[str, Any]
"""Arguments by name."""

_OF_COMPARE = {
    "only": "measures= with these names",
    "measure": 'measures= with a Measure(title, unit, "run", function), whose function is given a run',
    "worth": "benefit(comparison, loop)",
}
_OF_SWEEP = _OF_COMPARE | {
    "alpha": "plans = ctrlplan.studies.standard_plans(waypoints, alpha)",
    "title": "report(path, title)",
    "parameters": "parameters= of compare",
}


def _former(
    function: Callable[P, R], order: Sequence[str], notices: Mapping[str, str]
) -> Callable[..., Callable[P, R]]:
    """Decorator of what is made of all arguments by name, which shows the signature of a function."""

    def decorate(made: Callable[[Given], R]) -> Callable[P, R]:
        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            given = dict(zip(order, args, strict=False))
            if len(args) > len(order) or given.keys() & kwargs.keys():
                return function(*args, **kwargs)  # which says what there is too much of
            if "executor" in given:
                warn_renamed("sweep with executor and progress by position", "executor= and progress=")
            for name in notices:
                if name in kwargs:
                    warn_renamed(f"{name}= of {function.__name__}", notices[name])
            return made(given | kwargs)

        return called

    return decorate


@_former(_comparison.compare, ("loop", "plans", "timepts"), _OF_COMPARE)
def compare(given: Given) -> Comparison:
    """Comparison that takes `only`, `measure` and `worth` as well."""
    choices = _choices(given.pop("worth", False))
    return _with_worth(_comparison.compare(**_with_measures(given)), choices, given)


@_former(_sweep.sweep, ("build", "values", "plans", "timepts", "executor", "progress"), _OF_SWEEP)
def sweep(given: Given) -> Any:
    """Sweep that takes `params` of draws, `only`, `measure`, `worth`, `alpha`, `title` and `parameters` as well."""
    worth = given.pop("worth", False)
    texts: Given = {name: given.pop(name) for name in ("title", "parameters") if name in given}
    given = _with_measures(given)
    alpha = given.pop("alpha", None)
    if alpha is not None and not isinstance(given.get("plans", {}), Mapping):
        points = waypoints_given(given["plans"])
        given |= {"plans": standard_plans(points, alpha), "waypoints": points}
    if given.get("values") is None:
        return _drawn(given, texts, _choices(worth))
    if worth is not False:
        raise (ValueError if isinstance(worth, bool | Mapping) else TypeError)(
            f"worth must be False in a sweep over values, which has no place for it, got {worth!r:.80}; give compare's "
            "result at the value of interest to benefit"
        )
    return _sweep.sweep(**given)


def _drawn(given: Given, texts: Given, choices: Given | None) -> Any:
    """Draws as `sweep` made them with `params`."""
    if given.get("params") is None:
        raise TypeError("sweep() missing 1 required positional argument: 'values'; for draws use monte_carlo")
    warn_renamed("sweep with params=", "monte_carlo(loop, draws, plans, timepts)")
    rest = {name: value for name, value in given.items() if name not in ("build", "values", "params", "parameter")}
    found = monte_carlo(given["build"], given["params"], **rest)
    nominal = found.nominal
    if texts:
        parameters = dict(texts.get("parameters") or {}) | nominal.parameters
        nominal = replace(nominal, title=texts.get("title", nominal.title), parameters=parameters)
    return replace(found, nominal=_with_worth(nominal, choices, given | {"loop": given["build"]}))


def _choices(worth: object) -> Given | None:
    """Choices and options of `worth`; None where no benefit is wanted."""
    if not isinstance(worth, bool | Mapping):
        raise TypeError(f"worth must be True, False or a mapping of choices, got {worth!r}")
    return None if worth is False else dict(worth) if isinstance(worth, Mapping) else {}


def _with_worth(found: Comparison, choices: Given | None, given: Given) -> Comparison:
    """Comparison with the benefit that was wanted, as `compare` made it with `worth`."""
    if choices is None:
        return found
    if not found.waypoints or found.experiment is None:
        raise ValueError("worth needs waypoints, in the place of plans or as waypoints, got none")
    own = {entry.name: choices.pop(entry.name) for entry in fields(Choices) if entry.name in choices}
    shapes = (plan.alpha for plan in found.plans.values() if isinstance(plan, TrigSpline))
    own.setdefault("alpha", next(shapes, given.get("alpha", 1.0)))
    texts = {"units": found.units} | {name: choices.pop(name) for name in ("units", "title") if name in choices}
    measures: Given = {name: given[name] for name in ("measure", "measures") if name in given}
    last = "measure" in choices  # which was given the time of the last waypoint as well
    measures |= {name: choices.pop(name) for name in ("only", "measure", "measures") if name in choices}
    choices["measures"] = _with_measures(measures, last).get("measures")
    return found.with_benefit(benefit_of(replace(found.experiment, **choices), given["loop"], Choices(**own), **texts))


def _with_measures(given: Given, last: bool = False) -> Given:
    """Arguments with `only` and `measure` as `measures`."""
    if not {"only", "measure"} & set(given):
        return given
    rest = {name: value for name, value in given.items() if name not in ("only", "measure", "measures")}
    only, measure, own = given.get("only"), given.get("measure"), given.get("measures")
    if own is not None and not isinstance(own, Mapping):
        raise TypeError(f"measures must be a mapping of names to Measure, got {type(own).__name__}")
    measures = dict(own or {})
    if measure is not None:
        if not callable(measure):
            raise TypeError(f"measure must be a function of a plan and a response, got {measure!r:.80}")
        measures["measure"] = Measure("measure", "", "run", _Called(measure, last))
    if only is None:
        return rest | ({"measures": measures} if measures else {})
    only = tuple(only) if isinstance(only, Iterator) else only
    known = [*measures, *MEASURES]
    names = checked_names(only, known if measure is None or isinstance(only, str) else [*known, *only], "only")
    listed = [
        replace(one, name=name) for name, one in measures.items() if not one.of or one.of == "run" or name in names
    ]
    return rest | {"measures": [*listed, *(name for name in names if name in MEASURES)]}


@dataclass(frozen=True)
class _Called:
    """Function of a run that calls one of a plan and a response."""

    function: Function
    last: bool

    def __call__(self, run: Run) -> Mapping[str, float]:
        found = self.function(run.plan, run.response, *((run.last,) if self.last else ()))
        if not isinstance(found, Mapping):
            raise TypeError(f"measure must return a mapping of names to numbers, got {type(found).__name__}")
        return found
