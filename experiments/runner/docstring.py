"""What a study's docstring says: its question, and how it was gone about."""

from __future__ import annotations

import re
from dataclasses import dataclass

LABEL = re.compile(r"([A-Z][a-z]+): +(?=\S)")  # Method, Expectation, Source, ...
ITEM = re.compile(r"\s*([-*]|\d+\.) ")
RUN = "Run"
COMMAND = re.compile(r"sfm-calib run (\S+\.ya?ml)( .*)?")


@dataclass(frozen=True)
class Paragraph:
    """Of a study's docstring; the label is "" where it has none."""

    label: str
    text: str


@dataclass(frozen=True)
class Said:
    """A docstring in its parts."""

    question: str
    paragraphs: tuple[Paragraph, ...]  # without the command
    command: str  # that runs the study; "" where it is not said
    config: str  # the command's YAML, as it is written there


def said(docstring: str) -> Said:
    """The first line is the question; paragraphs and labels part the rest."""
    lines = docstring.strip().splitlines() or [""]
    paragraphs: list[Paragraph] = []
    new = True
    for line in lines[1:]:
        if not line.strip():
            new = True
        elif label := LABEL.match(line):
            paragraphs.append(Paragraph(label[1], line[label.end() :].strip()))
            new = False
        elif new or ITEM.match(line):
            paragraphs.append(Paragraph("", line.strip()))
            new = False
        else:
            last = paragraphs[-1]
            paragraphs[-1] = Paragraph(last.label, f"{last.text} {line.strip()}")
    run = next((one.text for one in paragraphs if one.label == RUN), "")
    command = COMMAND.search(run)
    return Said(
        question=lines[0].strip(),
        paragraphs=tuple(one for one in paragraphs if one.label != RUN),
        command=command[0].strip().rstrip(".") if command else "",
        config=command[1] if command else "",
    )
