"""A comparison with text and sections for a report."""

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
    """A comparison with text and sections for a report.

    Attributes
    ----------
    name : str
        Key in ``results.json``.
    title : str
        Heading.
    comparison : Comparison
        The comparison, whose metrics the page shows.
    summary : str
        Description of the study, one paragraph.
    notes : tuple of str
        Findings, one or two sentences each.
    sections : tuple of Section
        Further contents of the page, in order: see
        `ctrlplan.studies.sections`.
    text : tuple of str
        Free text of its author, a paragraph each.

    Raises
    ------
    TypeError
        If a section is not an instance of `Section`.
    """

    name: str
    title: str
    comparison: Comparison
    summary: str = ""
    notes: tuple[str, ...] = ()
    sections: tuple[Section, ...] = (PlanCurves(), Responses())
    text: tuple[str, ...] = ()

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
            If two sections, or a section and the comparison, use the same key.
        """
        data: dict[str, object] = {**self.comparison.results()}
        for place, section in enumerate(self.sections):
            found = section.results()
            twice = ", ".join(key for key in found if key in data)
            if twice:
                raise ValueError(
                    f"sections of study {self.name} must have unique keys in results.json, got {twice} again "
                    f"from sections[{place}], {type(section).__name__}"
                )
            data |= found
        return data
