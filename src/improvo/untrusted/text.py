"""YAML, JSON and XML from files that anyone may have written; every fault is a ValueError with one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.errors import InputError
from improvo.untrusted.limits import (
    MAX_JSON_BYTES,
    MAX_JSON_LISTS,
    MAX_JSON_VALUES,
    MAX_MESSAGE,
    MAX_YAML_BYTES,
    MAX_YAML_NODES,
)
from improvo.untrusted.paths import check_is_file, check_readable

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


def load_yaml(text: str) -> Any:
    """The first document that is not empty; None where there is none.

    Raises:
        ValueError: not YAML, more than plain values in it, or too large, aliases written out.
    """
    import yaml

    if len(text) > MAX_YAML_BYTES:
        raise ValueError(f"it has {len(text)} characters, more than {MAX_YAML_BYTES}")
    try:
        loader = yaml.SafeLoader(text)
        try:
            while loader.check_node():
                node = loader.get_node()
                _check_expanded(node)
                document = loader.construct_document(node)
                if document is not None:
                    return document
        finally:
            loader.dispose()
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    # PyYAML builds some values with plain Python: dates that do not exist, keys that are lists
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, OverflowError, LookupError, MemoryError) as error:
        raise ValueError(reason(error)) from None
    return None


def load_json(text: str) -> Any:
    """The value.

    Raises:
        ValueError: not JSON, or too large.
    """
    if len(text) > MAX_JSON_BYTES:
        raise ValueError(f"it has {len(text)} characters, more than {MAX_JSON_BYTES}")
    if text.count("[") + text.count("{") > MAX_JSON_LISTS or text.count(",") > MAX_JSON_VALUES:
        raise ValueError("it has too many values")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except (ValueError, MemoryError) as error:
        raise ValueError(reason(error)) from None


def read_json_file(path: Path, mend: str) -> dict[str, Any]:
    """The object in a JSON file that improvo wrote, as long as nobody touched it.

    Args:
        path: of the file.
        mend: how to mend it, for the message.

    Raises:
        FileNotFoundError: there is none.
        InputError: it may not or cannot be read, or is no JSON object.
    """
    check_is_file(check_readable(path))
    try:
        if path.stat().st_size > 4 * MAX_JSON_BYTES:
            raise ValueError("it is too large")
        content = load_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except (OSError, ValueError, MemoryError) as error:
        raise InputError(f"{path}: is damaged ({reason(error)}); {mend}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: is damaged (it holds no JSON object); {mend}")
    return content


def load_xml(text: str) -> Element:
    """The root of a document that defines no entities, which a few lines could blow up to gigabytes.

    Raises:
        ValueError: not XML, or it defines entities.
    """
    from xml.etree import ElementTree

    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise ValueError("it defines entities")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(str(error)) from None


def is_number(text: str) -> bool:
    """Whether it reads as a number, `nan` and `inf` too."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def reason(error: BaseException) -> str:
    """A foreign error on one line, not too long."""
    words = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(words.split())[:MAX_MESSAGE] or type(error).__name__


def _check_expanded(root: Any) -> None:
    """Refuse a document that is too large when each alias is written out, or that contains itself.

    Raises:
        ValueError: it is.
    """
    sizes: dict[int, int | None] = {}  # None while it is being counted

    def size(node: Any) -> int:
        key = id(node)
        if key in sizes:
            known = sizes[key]
            if known is None:
                raise ValueError("it contains itself")
            return known
        sizes[key] = None
        total = 1
        if isinstance(node.value, list):
            for item in node.value:
                total += sum(size(part) for part in item) if isinstance(item, tuple) else size(item)
                if total > MAX_YAML_NODES:
                    raise ValueError("it is too large when its aliases are written out")
        sizes[key] = total
        return total

    size(root)
