"""A folder of files of messages, read as one recording whose topics are the files."""

from collections.abc import Iterator
from pathlib import Path

from heliograph.files.bags.ros_bag import is_bag
from heliograph.files.messages.message_files import LINES, FileMessage, make_default_topic, read_message_file
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.files.text.text_file import find_extension
from heliograph.numerics.check import InputError, fail

LISTED = 8  # files in one line


def is_message_folder(path: Path) -> bool:
    """Return whether a path is a folder that may have files of messages: one that is no bag."""
    return path.is_dir() and not is_bag(path)


def list_message_files(folder: Path) -> list[Path]:
    """Return the message files directly in a folder, sorted by name: tables and files of lines.

    LINES: extensions of files with a message a line, such as .jsonl.

    Raises:
        ValueError: there is no such file.
    """
    kinds = (*LINES, ".csv", ".parquet")
    files = sorted(path for path in folder.iterdir() if path.is_file() and find_extension(path) in kinds)
    if not files:
        raise fail(str(folder), "a bag, or a folder with tables or files of lines", "a folder with neither")
    return files


def find_topic_of_file(path: Path, sources: TopicReader) -> str:
    """Return the topic of those messages of a file that name none: a form of the file's name.

    It is the full name if a source has it as a topic, else the name without ".gz".
    """
    return path.name if sources.of(path.name) else make_default_topic(path)


def list_used_files(folder: Path, sources: TopicReader) -> list[Path]:
    """Return the files of a folder that are topics of sources."""
    return [path for path in list_message_files(folder) if sources.of(find_topic_of_file(path, sources))]


def read_message_folder(folder: Path, sources: TopicReader) -> Iterator[FileMessage | InputError]:
    """Yield the messages of the files that sources read, file by file; an error in place of an unreadable message.

    A file's topic follows from its name, unless its messages have topics of their own.

    Raises:
        ValueError: no source reads any file, or a file cannot be read at all.
    """
    files = list_used_files(folder, sources)
    if not files:
        got = f"only {_join_names([path.name for path in list_message_files(folder)])}"
        raise fail(str(folder), f"a file that the sources name, {_join_names(sources.topics)}", got)
    for path in files:
        topic = find_topic_of_file(path, sources)
        for message in read_message_file(path):
            if isinstance(message, InputError) or message.topic is not None:
                yield message
            else:
                yield message._replace(topic=topic)


def describe_unused_files(folder: Path, sources: TopicReader) -> list[str]:
    """Return a line on files that no source reads, and a line on sources' topics for which there is no file.

    A topic with a wildcard (+ or #) never counts as missing.
    """
    used_files = list_used_files(folder, sources)
    unused = [path.name for path in list_message_files(folder) if path not in used_files]
    used_topics = {find_topic_of_file(path, sources) for path in used_files}
    missing = [topic for topic in sources.topics if not set("+#") & set(topic) and topic not in used_topics]
    lines = []
    if unused:
        lines.append(f"{folder}: not among the sources: {_join_names(unused)}")
    if missing:
        lines.append(f"{folder}: not in the folder: {_join_names(missing)}")
    return lines


def _join_names(names: list[str]) -> str:
    """Return names joined by commas: the first LISTED of them, and how many more there are."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{', '.join(names[:LISTED])}{more}"
