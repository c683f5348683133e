"""MkDocs hooks: pages that the navigation does not name, the options of every command, and the model cards."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

_OPTIONS_HERE = "<!-- options of all commands -->"
_CARDS_HERE = "<!-- model cards -->"
_WEIGHTS = Path(__file__).parents[1] / "src" / "improvo" / "frontend" / "weights"


def on_config(config: Any) -> Any:
    """Append the pages that `nav` does not name, so that none is lost."""
    named = set(_pages(config["nav"]))
    folder = Path(config["docs_dir"])
    others = [path.name for path in sorted(folder.glob("*.md")) if path.name not in named]
    if others:
        config["nav"].append({"In depth": others})
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put what `improvo VERB --help` prints, and the cards of the bundled weights, where a page asks for them."""
    for mark, lines in ((_OPTIONS_HERE, _help_texts), (_CARDS_HERE, _model_cards)):
        if mark in markdown:
            markdown = markdown.replace(mark, "\n".join(lines()))
    return markdown


def _pages(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in _pages(part)]


def _help_texts() -> list[str]:
    from improvo.cli.commands import leaves
    from improvo.cli.main import main

    lines = []
    for words, _ in leaves():
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            main([*words, "--help"])
        lines += [f"### `improvo {' '.join(words)}`", "", "```text", text.getvalue().strip(), "```", ""]
    return lines


def _model_cards() -> list[str]:
    lines = []
    for file in sorted(_WEIGHTS.glob("*.json")):
        card = json.loads(file.read_text())
        network = card["architecture"]
        lines += [
            f"## `{file.stem}`",
            "",
            f"Encoder {'-'.join(map(str, network['encoder']))}, heads {network['head']}, descriptor "
            f"{network['descriptor']}-D, {'with' if network['stability'] else 'without'} a stability head. "
            f"Licence of the weights: {card['licence']}. "
            + ("Calibrated for int8." if card["activation_ranges"] else "Runs in float32."),
            "",
            card["notes"],
            "",
            "| data | licence | attribution |",
            "|---|---|---|",
            *(f"| {entry['name']} | {entry['licence']} | {entry['attribution']} |" for entry in card["data"]),
            "",
            '??? note "Training and last metrics"',
            "",
            "    ```json",
            *(f"    {line}" for line in _indented(card)),
            "    ```",
            "",
        ]
    return lines


def _indented(card: dict[str, Any]) -> list[str]:
    kept = {name: card[name] for name in ("training", "metrics", "commit")}
    return json.dumps(kept, indent=2).splitlines()
