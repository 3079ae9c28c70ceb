"""Texts of others where something reads more into them than text: tables, spreadsheets, terminals.

Names of scenarios and policies, messages of errors and whatever else a store of trials holds may come from anybody.
"""

from __future__ import annotations

_MARKDOWN = "\\`*{}[]<>|~&"
"""Characters that begin markup within a line, that of MDX included, which has code in braces."""
_FORMULA = "=+-@"


def one_line(text: str) -> str:
    """Text for a terminal: line breaks are spaces, and characters that command it are written out."""
    return "".join(
        letter if letter.isprintable() else " " if letter.isspace() else letter.encode("unicode_escape").decode()
        for letter in text
    )


def markdown_text(text: str) -> str:
    """Text that Markdown reads as itself, on one line, in a cell of a table too."""
    return "".join(f"\\{letter}" if letter in _MARKDOWN else letter for letter in one_line(text))


def spreadsheet_cell(value: object) -> object:
    """A cell of a CSV file: text that a spreadsheet would compute has an apostrophe before it; numbers stay."""
    if not isinstance(value, str):
        return value
    text = one_line(value)
    computed = len(text) > 1 and text.lstrip().startswith(tuple(_FORMULA)) and not _is_number(text)
    return f"'{text}" if computed else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
