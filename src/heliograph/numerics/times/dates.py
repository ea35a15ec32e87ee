"""Times with dates and zones: ISO 8601 to datetime64[ns] in UTC."""

import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from heliograph.numerics.check import fail, show_value

DATE = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)(?:[T ](?P<clock>\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?))?"
    r" ?(?P<zone>Z?[+-]\d\d(?::?\d\d)?|Z|UTC|GMT)?"  # mosquitto_sub writes Z+0100
)
BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)[Tt](\d\d)(\d\d)(?:(\d\d)([.,]\d{1,9})?)?(.*)")  # of ISO 8601, without marks
LEAP_SECOND = re.compile(r"(\d\d:\d\d:)60")
MONTH = re.compile(r"(?P<year>\d{4})-(?:(?P<month>\d\d)|Q(?P<quarter>[1-4]))|(?P<of>\d{4})Q(?P<quarter_of>[1-4])")
YEAR = re.compile(r"\d{4}")  # where a date is expected; anywhere else it is a number
UNITS: dict[Literal["s", "ms", "us", "ns"], int] = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
MISSING = np.iinfo(np.int64).min  # NumPy's NaT
CALENDARS = ("standard", "gregorian", "proleptic_gregorian")  # of CF, which are ours from 1678 on
# Nanoseconds since 1970 of the dates that are read: 64 bits hold some of 1677 too, where NumPy's conversions overflow.
FIRST, LAST = int(np.datetime64("1678-01-01", "ns").astype(np.int64)), np.iinfo(np.int64).max
REACH = "from 1678 to 2262-04-11"


def round_to_nanoseconds(dates: np.ndarray) -> np.ndarray:
    """Return dates of any unit as datetime64[ns], with NaT for those before FIRST and after LAST.

    NumPy before 2.5 lets these overflow silently into other centuries; later versions raise, whichever row it is.
    """
    unit, count = np.datetime_data(dates.dtype)
    if unit in {"ps", "fs", "as"}:  # years around 1970
        return dates.astype("datetime64[ns]")
    if unit in {"Y", "M", "generic"}:  # of no fixed length
        dates, unit, count = dates.astype("datetime64[D]"), "D", 1
    size = int(np.array([1], f"timedelta64[{count}{unit}]").astype("timedelta64[ns]").astype(np.int64)[0])
    numbers = dates.astype(np.int64)
    within = (numbers >= -(-FIRST // size)) & (numbers <= LAST // size)  # NaT is none of these
    return np.asarray(np.where(within, dates, np.array("NaT", dates.dtype)).astype("datetime64[ns]"))


def looks_like_date(text: str) -> bool:
    """Return whether a text begins like a date of ISO 8601, or is a month (2026-11) or a quarter (2026Q4)."""
    return re.match(r"\d{4}-\d\d-|\d{8}[Tt]\d{4}", text) is not None or MONTH.fullmatch(text) is not None


def parse_dates(texts: Iterable[object], name: str) -> np.ndarray:
    """Return dates of ISO 8601 as datetime64[ns] in UTC, empty ones as NaT; one without a zone is taken as UTC."""
    results, zones = [], set()
    for row, element in enumerate(texts, 1):
        text = element.isoformat() if hasattr(element, "isoformat") else "" if element is None else str(element).strip()
        # A missing date is NaT.
        if not text or text == "NaT":
            results.append(MISSING)
            continue
        # Of climate models: years of 365 or 360 days, whose dates are others than ours of the same name.
        calendar = str(getattr(element, "calendar", CALENDARS[0]))
        if calendar not in CALENDARS:
            raise fail(f"{name}, row {row}", f"a date of the calendar {CALENDARS[0]}", f"{text} of {calendar}")
        # Nanoseconds since 1970 in UTC.
        moment, zoned = parse_moment(text, f"{name}, row {row}")
        results.append(moment)
        # Local times and times with a zone cannot be compared.
        zones.add(zoned)
        if len(zones) > 1:
            raise fail(f"{name}, row {row}", "a zone with every date or with none", show_value(text))
    return np.array(results, dtype=np.int64).view("datetime64[ns]")


def parse_moment(text: str, name: str) -> tuple[int, bool]:
    """Return a date as nanoseconds since 1970 in UTC, and whether the text has a time zone (else UTC is assumed).

    A month, a quarter or a year is its first day. A leap second (23:59:60 UTC at the end of a month) is the second
    after it, as clocks of computers have it. `name` is for errors.

    Raises:
        ValueError: no date of ISO 8601, or one beyond what nanoseconds can say.
    """
    text = text.strip()
    if YEAR.fullmatch(text):
        text = f"{text}-01-01"
    match_of_month = MONTH.fullmatch(text)  # of a month or a quarter, in one of two ways to write a year
    if match_of_month:
        year = match_of_month["year"] or match_of_month["of"]
        quarter = match_of_month["quarter"] or match_of_month["quarter_of"]
        month = match_of_month["month"] or f"{3 * int(quarter) - 2:02}"
        text = f"{year}-{month}-01"
    try:
        match, leap = _match_date(text)
        return _convert_to_nanoseconds(match, leap), match["zone"] is not None
    except ValueError:
        expected = f"a date as 2026-11-21T23:25:00+01:00, {REACH}, to the nanosecond"
        raise fail(name, expected, show_value(text)) from None


def _match_date(text: str) -> tuple[re.Match[str], bool]:
    """Return the match of a date's parts (day, zone, ...), and whether it is a leap second.

    A leap second is read as the second before it. A date without marks between its numbers (BASIC) gets them first.

    Raises:
        ValueError: no date of ISO 8601.
    """
    text = text.upper()
    basic = BASIC.fullmatch(text)
    if basic:
        year, month, day, hour, minute, second, fraction, zone = basic.groups(default="")
        text = f"{year}-{month}-{day}T{hour}:{minute}{second and ':'}{second}{fraction}{zone}"
    leap = LEAP_SECOND.search(text) is not None
    match = DATE.fullmatch(LEAP_SECOND.sub(r"\g<1>59", text) if leap else text)
    if match is None:
        raise ValueError
    return match, leap


def _convert_to_nanoseconds(match: re.Match[str], leap: bool) -> int:
    """Return the nanoseconds since 1970 in UTC of a date whose parts DATE matched.

    `leap`: whether it is the leap second after the second that was matched.

    Raises:
        ValueError: a date that does not exist or is not from FIRST to LAST; a leap second that ends no month.
    """
    # The whole seconds first, since those of a zone may lead into or out of what nanoseconds can say.
    local, _, fraction = _format_local(match).partition(".")
    seconds, zone = int(np.datetime64(local, "s").astype(np.int64)), _format_offset(match["zone"])
    if zone != "Z":
        hours, minutes = int(zone[1:3]), int(zone[-2:]) if len(zone) > 3 else 0
        if hours > 23 or minutes > 59:
            raise ValueError
        ahead = (60 * hours + minutes) * 60
        seconds += -ahead if zone[0] == "+" else ahead
    if leap:
        seconds += 1
        second = np.datetime64(seconds, "s")
        if second != second.astype("datetime64[M]"):  # leap seconds end a month in UTC
            raise ValueError
    nanoseconds = seconds * UNITS["s"] + int(fraction.ljust(9, "0"))
    if not FIRST <= nanoseconds <= LAST:
        raise ValueError
    return nanoseconds


def _format_local(match: re.Match[str]) -> str:
    """Return day and clock of a date, of which the fraction of a second may have a comma, with a point."""
    return f"{match['day']}T{(match['clock'] or '00:00').replace(',', '.')}"


def _format_offset(zone: str | None) -> str:
    """Return the zone of a date as an offset such as +01:00; "Z" for UTC, and for a date without a zone."""
    return "Z" if zone in (None, "Z", "UTC", "GMT") else str(zone).removeprefix("Z")


def parse_instant(text: str) -> datetime:
    """Return a date of ISO 8601 with its zone, to the microsecond; raise a bare ValueError if it has no zone.

    A leap second is returned in UTC.
    """
    match, leap = _match_date(text)
    if match["zone"] is None:
        raise ValueError
    nanoseconds = _convert_to_nanoseconds(match, leap)
    if leap:
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=nanoseconds // 1000)
    zone = _format_offset(match["zone"]).replace("Z", "+00:00")
    return datetime.fromisoformat(f"{_format_local(match)}{zone}")


def seconds_between(time: np.ndarray) -> np.ndarray:
    """Return the time since the previous row, 0 in the first row: in seconds for dates, else in the numbers' unit.

    Dates are subtracted as whole nanoseconds, since as doubles they would be exact only to some hundreds of these.
    """
    if time.dtype.kind != "M":
        return np.diff(time, prepend=time[:1])
    nanoseconds = time.astype("datetime64[ns]").astype(np.int64)
    return np.asarray(np.diff(nanoseconds, prepend=nanoseconds[:1]) / 1e9)


LONGER = 1.5  # times the usual step: then rows are missing; months and leap years differ by less
SPANS = {"years": 365.25 * 86400, "months": 30.4375 * 86400, "days": 86400.0, "hours": 3600.0, "minutes": 60.0}


def unequal_steps(time: np.ndarray) -> str:
    """Return a text as "steps of 1 and 21 years" if the longest step is more than LONGER times the median, else "".

    The two numbers are the median and the longest step. For dates they are in the largest unit of SPANS (in seconds)
    that the median nearly fills, for numbers they have no unit.
    """
    steps = seconds_between(time)[1:]
    # If no step exceeds LONGER times the shortest one, none exceeds LONGER times the median, which needs no sort.
    if steps.size and 0 < steps.max() <= LONGER * steps.min():
        return ""
    steps = steps[steps > 0]
    if not steps.size or steps.max() <= LONGER * np.median(steps):
        return ""
    median, longest = float(np.median(steps)), float(steps.max())
    if time.dtype.kind != "M":
        return f"steps of {median:g} and {longest:g}"
    unit, span = next(((name, span) for name, span in SPANS.items() if median >= 0.9 * span), ("seconds", 1.0))
    return f"steps of {round(median / span, 1):g} and {round(longest / span, 1):g} {unit}"


def format_dates(time: np.ndarray) -> np.ndarray:
    """Return the dates as texts in UTC, all with as many digits of a second as some date needs; a missing one is "".

    UNITS: the nanoseconds of each unit, the largest unit first.
    """
    nanoseconds = time[~np.isnat(time)].astype("datetime64[ns]").astype(np.int64)
    unit = next(unit for unit, size in UNITS.items() if not np.any(nanoseconds % size))  # the largest that is exact
    return np.asarray(np.where(np.isnat(time), "", np.datetime_as_string(time, unit=unit, timezone="UTC")))


DIGITS = 12  # of a number of seconds: .1 us since 1970's


def format_times(time: np.ndarray) -> list[str]:
    """Return times as texts for people: dates with as many digits of a second as some date needs, else numbers.

    A number has up to DIGITS (12) digits, so that the times of rows since 1970 differ, and 21.200000000000003 is 21.2.
    """
    if time.dtype.kind == "M":
        return [text.removesuffix("Z") for text in format_dates(time).tolist()]
    if time.dtype.kind != "f":  # whole numbers, of which the last digit counts
        return [str(moment) for moment in time.tolist()]
    return [f"{moment:.{DIGITS}g}" for moment in time.tolist()]


SPAN = re.compile(r"(?P<count>\d+(?:[.]\d+)?(?:e[+-]?\d+)?)\s*(?P<unit>ns|us|ms|s|min|h|d|w)")
NANOSECONDS = {
    "s": 10**9,
    "ms": 10**6,
    "us": 10**3,
    "ns": 1,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
    "d": 86400 * 10**9,
    "w": 7 * 86400 * 10**9,
}


def horizons_in(text: str) -> int | list[float | np.timedelta64 | np.datetime64]:
    """Return how far ahead a text says: "12" is a number of steps, and "5s, 1min, 2026-12-01" is a list.

    A list has spans, dates and numbers.

    Raises:
        ValueError: a part that is none of these.
    """
    if re.fullmatch(r"\s*\d+\s*", text):
        return int(text)
    return [_parse_horizon(part.strip()) for part in text.split(",")]


def _parse_horizon(text: str) -> float | np.timedelta64 | np.datetime64:
    """Return how far ahead a text says: a span (5s), a date, a whole number of steps, or seconds with a fraction."""
    span = SPAN.fullmatch(text)
    if span:
        return np.timedelta64(round(float(span["count"]) * NANOSECONDS[span["unit"]]), "ns")
    if looks_like_date(text):
        nanoseconds, _ = parse_moment(text, "horizon")
        return np.datetime64(nanoseconds, "ns")
    if re.fullmatch(r"\d+", text):
        return int(text)
    try:
        return float(text)
    except ValueError:
        raise fail("horizon", "a number of steps, or spans and dates as 5s,1min,2026-12-01", show_value(text)) from None


def read_compact_date(numbers: np.ndarray) -> str | None:
    """Return the first of some numbers as a date if all read as YYYYMMDD, or so with hours and minutes or seconds.

    None where one does not, or where they are no numbers. Dates are of the years 1900 to 2099.
    """
    if numbers.dtype.kind not in "fiu" or not len(numbers) or not np.all(numbers == np.floor(numbers)):
        return None
    days_of_month = np.array([31, 29, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])
    for clock_limits in ((), (60, 24), (60, 60, 24)):
        # Two digits after two from the right: seconds, minutes and hours, the day, the month, and four of the year.
        rest, fits = np.asarray(numbers), True
        for limit in clock_limits:
            rest, fits = rest // 100, fits and bool(np.all(rest % 100 < limit))
        day, month, year = rest % 100, rest // 100 % 100, rest // 10000
        fits = fits and bool(np.all((year >= 1900) & (year < 2100) & (month >= 1) & (month <= 12) & (day >= 1)))
        if fits and np.all(day <= days_of_month[month.astype(int) - 1]):
            first = f"{numbers[0]:.0f}"
            clock = ":".join(first[i : i + 2] for i in range(8, len(first), 2))
            return f"{first[:4]}-{first[4:6]}-{first[6:8]}" + (f"T{clock}" if clock else "")
    return None
