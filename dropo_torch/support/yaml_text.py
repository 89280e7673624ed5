"""The one way in which YAML is read: plain data of a bounded size, and every mistake told in one line."""

from __future__ import annotations

import re
from typing import Any

import yaml

from dropo_torch.errors import InputError

#: Entries, aliases written out, levels of nesting, and characters of a key.
MOST_ENTRIES, DEEPEST, LONGEST_KEY = 100_000, 50, 200
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x84\x86-\x9f\ud800-\udfff]")
_TAGS = ("str", "int", "float", "bool", "null", "merge", "map", "seq")


def load_yaml(text: str, where: str) -> Any:
    """Return the plain data of a YAML text: mappings, lists, text, numbers, truth values and ``None``.

    Numbers are as people write them: 1e-5 is one, although YAML 1.1 wants 1.0e-5. Dates and times are text.

    Args:
        text: the YAML.
        where: names it in messages.

    Raises:
        InputError: no YAML; a key that stands twice; another tag; more than :data:`MOST_ENTRIES` entries, deeper than
            :data:`DEEPEST`; text with control characters.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:  # without the line itself, which may be long
        mark = error.problem_mark or error.context_mark
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        quote = "; quote entries with brackets or colons in a list, such as ['qpos[1:]', qvel]"
        remedy = quote if str(error.problem).startswith("expected ',' or ']'") else ""
        raise InputError(f"{where} is no valid YAML: {error.problem or error.context}{place}{remedy}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{where} is no valid YAML: {error}") from None


class _Loader(yaml.SafeLoader):
    """Plain data only, of a bounded size."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012 - what follows is all that text may mean

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        self._entries: dict[int, int] = {}  # of each node, with all below it

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node, and refuse what is too deep, too much or contains itself."""
        mark, is_alias = self.peek_event().start_mark, self.check_event(yaml.AliasEvent)
        self._depth += 1
        if self._depth > DEEPEST:
            raise yaml.MarkedYAMLError(None, None, f"more than {DEEPEST} levels of nesting", mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias and id(node) not in self._entries:
            raise yaml.MarkedYAMLError(None, None, "an entry contains itself", mark)
        if not is_alias:
            below = node.value if isinstance(node, yaml.CollectionNode) else ()
            children = (child for entry in below for child in (entry if isinstance(entry, tuple) else (entry,)))
            self._entries[id(node)] = 1 + sum(self._entries[id(child)] for child in children)
        if self._entries[id(node)] > MOST_ENTRIES:
            raise yaml.MarkedYAMLError(None, None, f"more than {MOST_ENTRIES:,} entries", mark)
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """Refuse tags of other types than plain ones, and values that their tag does not fit."""
        if node.tag.removeprefix("tag:yaml.org,2002:") not in _TAGS:
            raise yaml.MarkedYAMLError(None, None, f"tag {node.tag!r} is not understood", node.start_mark)
        try:
            found = super().construct_object(node, deep)
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            what = f"{str(node.value)[:50]!r} does not fit its tag ({type(error).__name__})"
            raise yaml.MarkedYAMLError(None, None, what, node.start_mark) from None
        if isinstance(found, str) and (control := _CONTROL.search(found)):
            what = f"text holds the control character {control[0]!r}"
            raise yaml.MarkedYAMLError(None, None, what, node.start_mark)
        return found

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that would silently replace an earlier one, one that is no word, and one without end."""
        seen: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(None, None, "a key is a list or a mapping", key.start_mark)
            if len(key.value) > LONGEST_KEY:
                what = f"a key has {len(key.value):,} characters; at most {LONGEST_KEY}"
                raise yaml.MarkedYAMLError(None, None, what, key.start_mark)
            if key.value in seen and key.value != "<<":
                raise yaml.MarkedYAMLError(None, None, f"key {key.value!r} stands there twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
    ("bool", r"yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF", "yYnNtTfFoO"),
    ("int", r"[-+]?(0|[1-9][0-9_]*|0x[0-9a-fA-F_]+)", "-+0123456789"),
    ("float", r"[-+]?(\d[\d_]*(\.\d*)?|\.\d+)([eE][-+]?\d+)|[-+]?(\d+\.\d*|\.\d+)|[-+]?\.(inf|Inf)|\.(nan|NaN)",
     "-+0123456789."),
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("merge", "<<", "<"),
):  # fmt: skip
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), [*_first, ""])
