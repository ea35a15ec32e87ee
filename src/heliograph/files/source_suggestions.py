"""Sources of a network to paste into its file, suggested by what messages of each topic have."""

from collections.abc import Mapping, Sequence

from heliograph.files.topic_statistics import TopicStatistics

DEGREES = ("deg", "degs", "degree", "degrees", "°")  # of an angle
FEW = 6  # fields that a suggestion lists


def suggest_sources(topics: Mapping[str, TopicStatistics], names: Mapping[str, Sequence[str]]) -> str:
    """Return sources to paste into a network's file: a line for each topic that has numbers.

    Args:
        topics: by topic what was seen of it: its fields, dates, times of logging and clock.
        names: outputs by node, and the inputs; empty if no network is known.
    """
    lines = [f"# {node}: {', '.join(outputs)}" for node, outputs in names.items()]
    lines.append("sources = {")
    for topic in topics.values():
        topic.choose_time_field()
    # If any topic has dates, a clock that counts from its own start needs the date of this start.
    dated = any(topic.dates or (topic.logged and not topic.own_clock) for topic in topics.values())
    for name, topic in sorted(topics.items()):
        fields = topic.list_fields_by_likelihood()
        if not fields:
            continue
        options = _suggest_options(topic, dated)
        source = f"hg.files.json_field({fields[0]!r}, node='NODE', output='OUTPUT'{options})"
        lines.append(f"    {name!r}: {source},{_comment_on_unit(topic, fields[0])}")
        # Beside it the next of the first FEW fields, as comments.
        others = [f"{path}{_comment_on_unit(topic, path, '')}" for path in fields[1:FEW]]
        more = ", ".join(others) + (", ..." if len(fields) > FEW else "")
        if more:
            lines.append(f"    #   or {more}")
    return "\n".join([*lines, "}"])


def _suggest_options(topic: TopicStatistics, dated: bool) -> str:
    """Return a source's options for a topic's time field and running count, as Python code; "" if there are none.

    `dated`: whether any topic has dates.
    """
    options = ""
    if topic.time is not None:
        options += f", time={_write_time_option(topic, dated)}"
        unit = topic.units.get(topic.time, "s")
        options += "" if unit == "s" else f", time_unit={unit!r}"
    if topic.count is not None:
        options += f", sequence={_write_count_option(topic, topic.count)}"
    return options


def _write_time_option(topic: TopicStatistics, dated: bool) -> str:
    """Return the Python code of a source's time field.

    If other topics have dates (`dated`), a clock that counts from its own start needs the date of this start. 'DATE'
    stands for it, for the user to fill in.
    """
    return f"hg.files.Stamp({topic.time!r}, start='DATE')" if topic.own_clock and dated else repr(topic.time)


def _write_count_option(topic: TopicStatistics, path: str) -> str:
    """Return the Python code of a source's running count: its path, and its number of bits if the file gives it."""
    return f"hg.files.Count({path!r}, bits={topic.bits[path]})" if path in topic.bits else repr(path)


def _comment_on_unit(topic: TopicStatistics, path: str, mark: str = "  #") -> str:
    """Return the unit of a field as a Python comment, or "" if the file names no unit.

    Angles in the network are in radians. For degrees (DEGREES holds the ways to write them) the comment says how to
    convert them.
    """
    if path not in topic.measured_in:
        return ""
    unit = topic.measured_in[path]
    remedy = " (of an angle: scale=np.pi / 180)" if unit.lower().strip() in DEGREES else ""
    return f"{mark} {unit}{remedy}"
