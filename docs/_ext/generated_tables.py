"""Directives for what the code knows better than a page: flags, commands, public names."""

from __future__ import annotations

from collections.abc import Iterator

import click
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

import fdnt_xp
from fdnt_xp.app.cli import main
from fdnt_xp.app.runner import IMAGE_COLUMNS
from fdnt_xp.data.provenance import COMMENTS
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.shapes.results import COLUMNS, PSF_COLUMNS, SKY_COLUMNS
from fdnt_xp.shears.responses import COLUMNS as RESPONSES


class FlagTable(SphinxDirective):
    """Every flag: bit, value, name, whether eta is NaN with it, and its docstring."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        texts = ModuleAnalyzer.for_module(Flag.__module__).find_attr_docs()
        lines = ["| bit | value | name | eta | meaning |", "|---|---|---|---|---|"]
        for flag in Flag:
            text = " ".join(texts["Flag", flag.name]).strip()
            eta = "NaN" if flag & FAILED else "given"
            bit = int(flag).bit_length() - 1
            lines.append(f"| {bit} | {int(flag)} | `{flag.name}` | {eta} | {text} |")
        return self.parse_text_to_nodes("\n".join(lines))


class PublicNames(SphinxDirective):
    """The names in `fdnt_xp.__all__`, each with its first sentence and a link to its page."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        lines = ["| name | what it is |", "|---|---|"]
        for name in fdnt_xp.__all__:
            member = getattr(fdnt_xp, name)
            if hasattr(member, "__qualname__"):
                target = f"{member.__module__}.{member.__qualname__}"
                summary = (member.__doc__ or "").partition("\n")[0]
                lines.append(f"| {{py:obj}}`fdnt_xp.{name} <{target}>` | {summary} |")
        return self.parse_text_to_nodes("\n".join(lines))


class ColumnTable(SphinxDirective):
    """The columns of catalogs, each with its unit and description, by groups."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the table of the group that is named."""
        lines = ["| column | unit | meaning |", "|---|---|---|"]
        for name, (unit, text) in COLUMN_GROUPS[self.arguments[0]].items():
            lines.append(f"| `{name}` | {unit or ''} | {text.replace('|', chr(92) + '|')} |")
        return self.parse_text_to_nodes("\n".join(lines))


class HeaderTable(SphinxDirective):
    """The keywords of the header of a catalog, each with its meaning."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        lines = ["| keyword | meaning |", "|---|---|"]
        lines += [f"| `{name}` | {text} |" for name, text in COMMENTS.items()]
        return self.parse_text_to_nodes("\n".join(lines))


COLUMN_GROUPS = {
    "image": IMAGE_COLUMNS,
    "shapes": {name: of for name, of in COLUMNS.items() if name not in IMAGE_COLUMNS},
    "sky": SKY_COLUMNS,
    "psf": PSF_COLUMNS,
    "responses": {name: of for name, of in RESPONSES.items() if name not in IMAGE_COLUMNS},
}


class CommandHelp(SphinxDirective):
    """What `--help` prints, for the command and each of its subcommands."""

    def run(self) -> list[nodes.Node]:
        """Return one section per command."""
        sections = [
            f"## `{context.command_path}`\n\n```text\n{context.get_help()}\n```"
            for context in _contexts(main, "fdnt-xp", None)
        ]
        return self.parse_text_to_nodes("\n\n".join(sections), allow_section_headings=True)


def _contexts(
    command: click.Command, name: str, parent: click.Context | None
) -> Iterator[click.Context]:
    context = click.Context(command, info_name=name, parent=parent, max_content_width=88)
    yield context
    if isinstance(command, click.Group):
        for child in command.list_commands(context):
            yield from _contexts(command.commands[child], child, context)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("column-table", ColumnTable)
    app.add_directive("flag-table", FlagTable)
    app.add_directive("header-table", HeaderTable)
    app.add_directive("public-names", PublicNames)
    app.add_directive("command-help", CommandHelp)
    return {"parallel_read_safe": True}
