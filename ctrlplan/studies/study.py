"""A comparison with what a report says around it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ctrlplan._display import Displayed, Part
from ctrlplan.studies.sections import PlanCurves, Responses, Section

if TYPE_CHECKING:  # comparisons and ensembles make studies of themselves for their pages
    from ctrlplan.studies.comparison import Comparison


@dataclass(frozen=True, repr=False)
class Study(Displayed):
    """A comparison with what a report says around it.

    Attributes
    ----------
    name : str
        Key in ``results.json``.
    title : str
        Heading.
    comparison : Comparison
        What was compared; its metrics are on the page.
    summary : str
        What the study is, in a paragraph.
    notes : tuple of str
        Findings, one sentence or two each; where a claim fails they say so.
    sections : tuple of Section
        What the page shows around the metrics, in order: see
        `ctrlplan.studies.sections`.

    Raises
    ------
    TypeError
        If a section is of no type of sections.
    """

    name: str
    title: str
    comparison: Comparison
    summary: str = ""
    notes: tuple[str, ...] = ()
    sections: tuple[Section, ...] = (PlanCurves(), Responses())

    def __post_init__(self) -> None:
        given: tuple[object, ...] = tuple(self.sections)
        for place, section in enumerate(given):
            if not isinstance(section, Section):
                got = f"the class {section.__name__}" if isinstance(section, type) else type(section).__name__
                raise TypeError(f"sections must be instances of subclasses of Section, got {got} as sections[{place}]")

    def _describe(self) -> Iterator[Part]:
        yield f"Study {self.name}: {self.title}"
        if self.summary:
            yield self.summary
        yield self.comparison.metric_table()
        yield from self.notes

    def results(self) -> dict[str, object]:
        """Plain data for ``results.json``.

        Raises
        ------
        ValueError
            If two sections, or a section and the comparison, have data under
            one key.
        """
        data: dict[str, object] = {**self.comparison.results()}
        for place, section in enumerate(self.sections):
            found = section.results()
            twice = ", ".join(key for key in found if key in data)
            if twice:
                raise ValueError(
                    f"sections of study {self.name} must have keys of their own in results.json, got {twice} again "
                    f"from sections[{place}], {type(section).__name__}"
                )
            data |= found
        return data
