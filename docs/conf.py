"""Sphinx configuration. Build with ``make docs``."""

from __future__ import annotations

import gc
import os
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from sphinx.ext.napoleon import GoogleDocstring
from sphinx.pycode import ModuleAnalyzer

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))  # for what lies beside this file
# What is collected is worth less than the looking for it, in which JAX, once imported, takes part.
gc.disable()
os.environ["SCIPY_ARRAY_API"] = "1"  # without which d4orm_env.crazyflow is not imported beside SciPy

project = "d4orm-env"
author = "d4orm-env contributors"
copyright = "2026, d4orm-env contributors"
release = installed_version("d4orm-env")
version = release

extensions = ["myst_parser", "sphinx.ext.apidoc", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "_extra", "tables"]

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# One page per module that exists, so that none can be forgotten; api.md leads to them. Commands are in cli.md: as
# functions they have defaults that say nothing.
apidoc_modules = [
    {
        "path": f"../{package}",
        "destination": f"reference/{package}",
        "exclude_patterns": ["../d4orm_planners/cli/*"],
        "separate_modules": True,
        "module_first": True,
        "automodule_options": {"members", "show-inheritance"},
    }
    for package in ("d4orm_env", "d4orm_planners")
]
autodoc_member_order = "bysource"
# Names that a package passes on are described where they are defined.
autodoc_default_options = {"ignore-module-all": True}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_use_type_comments = False  # of which there are none
# Optional extras that a build of the documentation does without.
autodoc_mock_imports = [
    "benchmarl",
    "casadi",
    "crazyflow",
    "h5py",
    "jaxmarl",
    "minari",
    "msgpack",
    "pyarrow",
    "pyrvo",
    "ray",
    "trimesh",
    "viser",
    "zenoh",
]
# As fields of the class and not as entries of their own: autodoc lists the documented attributes itself.
napoleon_use_ivar = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# Else what is before a colon in the description of an attribute would be taken for its type.
GoogleDocstring._parse_attribute_docstring = GoogleDocstring._consume_to_end

# The modules' pages are not in the navigation: with hundreds of entries it is most of every page and of the build.
suppress_warnings = ["toc.not_included"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_extra_path = ["_extra"]  # what is in it lies beside the pages
html_title = "d4orm-env"


def _skip_described_field(app: Any, what: str, name: str, member: Any, skip: bool, options: Any) -> bool | None:
    """Leave out a NamedTuple's ``Alias for field number 0``, unless the field is described beside itself."""
    if not str(getattr(member, "__doc__", "")).startswith("Alias for field number"):
        return None
    analyzer = ModuleAnalyzer.for_module(app.env.temp_data["autodoc:module"])
    analyzer.analyze()
    return None if (app.env.temp_data["autodoc:class"], name) in analyzer.attr_docs else True


def _read_report(app: Any, page: str, source: list[str]) -> None:
    """Show the studies' ``REPORT.md`` as a page, with tables in place of the links to them.

    Its other links, and other pages' links to it, lead from page to page. Where it has several tables with headings,
    their title is left out.
    """
    if page == "background/report":
        report = HERE.parent / "examples" / "studies" / "REPORT.md"
        app.env.note_dependency(report)
        text = report.read_text(encoding="utf-8").replace("](../../docs/", "](../")
        text = re.sub(r"^\[Table\]\((.+)\)$", r"```{include} \1\n```", text, flags=re.MULTILINE)
        tables = r"```{include} \1\n:start-line: 2\n:heading-offset: 1\n```"
        source[0] = re.sub(r"^\[Tables\]\((.+)\)$", tables, text, flags=re.MULTILINE)
    source[0] = source[0].replace("../examples/studies/REPORT.md", "background/report.md")


def _write_generated(app: Any, config: Any) -> None:
    """Have the replays that the pages show, and the page of settings.

    Replays come first and not beside Sphinx: they show how long a planner took.
    """
    from replays import write_replays
    from settings_page import write_settings

    write_replays(HERE / "_extra" / "replays")
    write_settings(HERE / "reference" / "settings.md")


def setup(app: Any) -> None:
    """Connect what the extensions leave to the project."""
    from python_names import IndexedPythonDomain

    app.add_domain(IndexedPythonDomain, override=True)
    app.connect("config-inited", _write_generated)
    app.connect("source-read", _read_report)
    app.connect("autodoc-skip-member", _skip_described_field)
