"""Strokes in InkML (Ink Markup Language, W3C Recommendation of 20 September 2011), y down.

Traces with any channels, of which `X`, `Y` and, where all have it, `Z` are read; values explicit (`!`), first (`'`) and
second (`"`) differences, `*` and `?`; channels of type integer, decimal, double and boolean; `-ve` orientation; trace
formats in contexts and ink sources; continued traces; `traceGroup` and `traceView`. Pen-up traces are left out.

The traces of an innermost group are the pieces of one stroke, with the group's annotation of type `truth` or `label` as
its label; a trace in no group is a stroke of its own. The document's annotation of type `writer` is the person.
"""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfilters.trackers.io.errors import InputError, shortened, shown
from jaxfilters.trackers.io.input_files import LARGEST
from jaxfilters.trackers.io.xml_files import read_xml

SUFFIXES = (".inkml",)
_WANTED = "expected InkML with traces of X and Y"
_VALUE = re.compile(
    r"""\s*([!'"]?)\s*(-?\s*(?:\.\d+|\d+\.?\d*)(?:[eE][+-]?\d+)?|-?\s*\#[0-9A-Fa-f]+|[TF*?])""", re.ASCII
)
_LABELS, _PERSONS = ("truth", "label"), ("writer", "person")
_ID = "{http://www.w3.org/XML/1998/namespace}id"
_ORDER = {"!": 0, "'": 1, '"': 2}
_MOST_PIECES, _MOST_REFERENCES = 100_000, 20
Piece = Float[np.ndarray, "_ d"]


class InkmlFile(NamedTuple):
    """What a file of InkML holds."""

    strokes: list[tuple[list[Piece], str]]
    """Pieces and label of each; the label is empty where there is none."""
    ids: list[str]
    person: str
    """Empty where none is named."""


class _Channels(NamedTuple):
    names: tuple[str, ...] = ("X", "Y")
    signs: tuple[int, ...] = (1, 1)
    num_regular: int = 2
    """Those that every point has; the others are intermittent."""


def read_inkml(path: Path) -> InkmlFile:
    """The strokes of a file.

    Raises:
        InputError: an unreadable file, no InkML, references to what is not there, values that are none, or no trace.
    """
    root = read_xml(path, _WANTED)
    _strip_namespaces(root)
    if root.tag != "ink":
        raise InputError(f"{path}: its outermost element is {shown(root.tag)}; {_WANTED}.")
    reader = _Reader(path, root)
    reader.collect(root, None, False)
    if not reader.traces:
        raise InputError(f"{path}: without traces; {_WANTED}.")
    strokes, ids = _strokes(root, reader)
    has_depth = all(piece.shape[1] == 3 for pieces, _ in strokes for piece in pieces)
    strokes = [([piece[:, : 3 if has_depth else 2] for piece in pieces], label) for pieces, label in strokes]
    return InkmlFile(strokes, ids, _annotation(root, _PERSONS))


class _Reader:
    """The traces of a document by identity, each with the channels of its context."""

    def __init__(self, path: Path, root: ElementTree.Element):
        self.path = path
        self.named = {name: element for element in root.iter() if (name := element.get(_ID))}
        self.traces: dict[int, Piece] = {}
        """By Python's identity of their element; only those of a pen that is down."""

    def collect(self, element: ElementTree.Element, context: ElementTree.Element | None, is_defined: bool) -> None:
        """Read all traces below an element, which stand in a context; what is only defined sets no context."""
        context = self.find(element.get("contextRef"), element) if element.get("contextRef") else context
        for child in element:
            if (child.tag == "context" and not is_defined) or (child.tag == "traceFormat" and not is_defined):
                context = child
            elif child.tag == "trace" and child.get("type", "penDown") != "penUp":
                own = self.find(child.get("contextRef"), child) if child.get("contextRef") else context
                self._add(child, _points(child.text or "", self._channels(own), self._place(child)))
            elif child.tag in ("traceGroup", "definitions"):
                self.collect(child, context, child.tag == "definitions")

    def find(self, reference: str | None, source: ElementTree.Element) -> ElementTree.Element:
        """The element that a reference names.

        Raises:
            InputError: there is none in this document.
        """
        found = self.named.get((reference or "").strip().removeprefix("#"))
        if found is None:
            raise InputError(f"{self.path}: {source.tag} refers to {shown(reference)}, which is not in the file.")
        return found

    def _add(self, trace: ElementTree.Element, points: Piece) -> None:
        if trace.get("continuation") in ("middle", "end") and trace.get("priorRef"):
            before = self.traces.pop(id(self.find(trace.get("priorRef"), trace)), points[:0])
            if before.shape[1] == points.shape[1]:
                points = np.concatenate([before, points])
        self.traces[id(trace)] = points

    def _channels(self, context: ElementTree.Element | None, depth: int = 0) -> _Channels:
        """Of a context, an ink source or a trace format; of X and Y where none of them says."""
        if context is None:
            return _Channels()
        if depth > _MOST_REFERENCES:
            raise InputError(f"{self.path}: {context.tag} {shown(context.get(_ID))} refers to itself, or too far on.")
        if context.tag == "traceFormat":
            return self._format(context)
        for tag in ("traceFormat", "inkSource"):
            inner = context.find(tag)
            if inner is not None:
                return self._channels(inner, depth + 1)
        for name in ("traceFormatRef", "inkSourceRef", "contextRef"):
            if reference := context.get(name):
                # The recommendation's own default.
                is_default = reference.strip("#") == "DefaultTraceFormat" and "DefaultTraceFormat" not in self.named
                return _Channels() if is_default else self._channels(self.find(reference, context), depth + 1)
        return _Channels()

    def _format(self, element: ElementTree.Element) -> _Channels:
        intermittent = element.find("intermittentChannels")
        regular = element.findall("channel")
        channels = regular + ([] if intermittent is None else intermittent.findall("channel"))
        names = tuple(channel.get("name", "").strip() for channel in channels)
        if not {"X", "Y"} <= set(names[: len(regular)]) or len(set(names)) < len(names):
            raise InputError(
                f"{self.path}: a traceFormat must name X and Y, each once; got {shortened(', '.join(names))}."
            )
        signs = tuple(-1 if channel.get("orientation") == "-ve" else 1 for channel in channels)
        return _Channels(names, signs, len(regular))

    def _place(self, trace: ElementTree.Element) -> str:
        return f"{self.path}: trace {shown(trace.get(_ID) or len(self.traces))}"


def _points(text: str, channels: _Channels, place: str) -> Piece:
    """(points, 2 or 3) of the text of a trace."""
    wanted = [channels.names.index(name) for name in ("X", "Y", "Z") if name in channels.names[: channels.num_regular]]
    # Per channel: order of the differences, value, first and second difference.
    order, value = [0] * len(channels.names), np.zeros((len(channels.names), 3))
    rows = []
    for number, point in enumerate(text.strip().removesuffix(",").split(",") if text.strip() else []):
        found = _values(point, f"{place}, point {number}")
        if not channels.num_regular <= len(found) <= len(channels.names):
            expected = f"{channels.num_regular} to {len(channels.names)} values"
            raise InputError(f"{place}, point {number}: expected {expected}; got {shown(point.strip())}.")
        for channel, (prefix, word) in enumerate(found):
            order[channel] = _ORDER.get(prefix, order[channel])
            value[channel] = _next(value[channel], order[channel], word)
        row = value[wanted, 0] * [channels.signs[channel] for channel in wanted]
        if any(found[channel][1] in "TF?" for channel in wanted) or not (np.abs(row) <= LARGEST).all():
            raise InputError(f"{place}, point {number}: X and Y must be finite numbers; got {shown(point.strip())}.")
        rows.append(row)
    return np.array(rows).reshape(-1, len(wanted))


def _values(point: str, place: str) -> list[tuple[str, str]]:
    """Prefix and value of each channel."""
    found, end = [], 0
    while end < len(point.rstrip()):
        match = _VALUE.match(point, end)
        if match is None:
            raise InputError(f"{place}: expected numbers; got {shown(point.strip())}.")
        found.append((match[1], match[2]))
        end = match.end()
    return found


def _next(state: np.ndarray, order: int, word: str) -> np.ndarray:
    """Value, first and second difference of a channel after one more word."""
    value, first, second = state
    if word == "*":
        # As before: the value, the velocity or the acceleration.
        number = (value, first, second)[order]
    elif word in "TF?":
        return state
    else:
        digits = re.sub(r"\s", "", word)
        number = float(int(digits.replace("#", ""), 16)) if "#" in digits else float(digits)
    if order == 2:
        first, second = first + number, number
    elif order == 1:
        first, second = number, number - first
    else:
        return np.array([number, number - value, number - value - first])
    return np.array([value + first, first, second])


def _strokes(root: ElementTree.Element, reader: _Reader) -> tuple[list[tuple[list[Piece], str]], list[str]]:
    """Groups that hold traces and no other groups, and the traces in none of them."""
    strokes: list[tuple[list[Piece], str]] = []
    ids: list[str] = []
    grouped: set[int] = set()
    for group in root.iter("traceGroup"):
        if group.find("traceGroup") is not None:
            continue
        found = [one for child in group for one in _traces_of(child, reader)]
        grouped |= {id(trace) for trace in found}
        pieces = [reader.traces[id(trace)] for trace in found if id(trace) in reader.traces]
        if pieces := [piece for piece in pieces if len(piece)]:
            strokes.append((pieces, _annotation(group, _LABELS)))
            ids.append(group.get(_ID) or str(len(ids)))
        if sum(len(pieces) for pieces, _ in strokes) > _MOST_PIECES:
            raise InputError(f"{reader.path}: groups of more than {_MOST_PIECES} traces.")
    for trace in root.iter("trace"):
        piece = reader.traces.get(id(trace))
        if piece is not None and len(piece) and id(trace) not in grouped:
            strokes.append(([piece], _annotation(trace, _LABELS)))
            ids.append(trace.get(_ID) or str(len(ids)))
    return strokes, ids


def _traces_of(element: ElementTree.Element, reader: _Reader) -> list[ElementTree.Element]:
    """A trace itself, or the trace or group that a `traceView` shows."""
    if element.tag == "trace":
        return [element]
    if element.tag != "traceView" or not element.get("traceDataRef"):
        return []
    return list(reader.find(element.get("traceDataRef"), element).iter("trace"))


def _annotation(element: ElementTree.Element, kinds: tuple[str, ...]) -> str:
    texts = [(one.text or "").strip() for one in element.findall("annotation") if one.get("type") in kinds]
    return texts[0] if texts else ""


def _strip_namespaces(root: ElementTree.Element) -> None:
    """Names without the namespace of InkML, in which some files write them and some do not; ids in any spelling."""
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""
        if element.get(_ID) is None and element.get("id") is not None:
            element.set(_ID, element.get("id", ""))
