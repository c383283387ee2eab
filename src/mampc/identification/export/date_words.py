"""Dates in words: days of the week, months in several languages and names of zones, as `strptime` reads them."""

from __future__ import annotations

import re
from calendar import isleap
from datetime import date, timedelta

# First letters that tell a month in English, German, French, Spanish, Italian, Dutch, Portuguese, Russian, Polish.
MONTHS = (
    ("jan", "ene", "gen", "jän", "янв", "sty"), ("feb", "fév", "fev", "фев", "lut"),
    ("mar", "mär", "mrz", "maa", "mrt", "мар"), ("apr", "avr", "abr", "апр", "kwi"),
    ("may", "mai", "mag", "mei", "maj", "мая", "май"), ("jun", "juin", "giu", "июн", "cze"),
    ("jul", "juil", "lug", "июл", "lip"), ("aug", "aoû", "aou", "ago", "авг", "sie"),
    ("sep", "set", "сен", "wrz"), ("oct", "okt", "ott", "out", "окт", "paź"), ("nov", "ноя", "lis"),
    ("dec", "dez", "déc", "dic", "des", "дек", "gru"),
)  # fmt: skip
ENGLISH = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
BY_LETTERS = {word: name for name, words in zip(ENGLISH, MONTHS, strict=True) for word in words}
# Only differences count: where one name stands everywhere, another zone of that name gives the same steps.
ZONES = {
    "UTC": "+0000", "GMT": "+0000", "WET": "+0000", "WEST": "+0100", "BST": "+0100", "CET": "+0100", "MEZ": "+0100",
    "CEST": "+0200", "MESZ": "+0200", "EET": "+0200", "EEST": "+0300", "MSK": "+0300", "IST": "+0530", "JST": "+0900",
    "AEST": "+1000", "AEDT": "+1100", "EST": "-0500", "EDT": "-0400", "CST": "-0600", "CDT": "-0500", "MST": "-0700",
    "MDT": "-0600", "PST": "-0800", "PDT": "-0700", "BRT": "-0300",
}  # fmt: skip
WEEKDAY = re.compile(r"^([^\W\d_]{2,10})\.?,? +(?=(\d)|[^\W\d_]+\.? +\d)")
MONTH = re.compile(r"(?<![^\W_])([^\W\d_]{3,10})(?:\.(?!\d))?(?![^\W\d_])")
ZONE = re.compile(rf" ?\b({'|'.join(ZONES)})\b")
YEAR_LAST = re.compile(r"^(\w+ \d+) (\d+:[\d:.,]+) ?([+-]\d{4})?,? (\d{4})$")
JOINED = re.compile(r"(/\d{4}):(\d\d:)")
OFFSET = re.compile(r"(:\d\d(?:[.,]\d+)?(?: [AaPp][Mm])?) ([+-]\d\d:?\d\d)$")
KANJI = str.maketrans({"年": "-", "月": "-", "日": " ", "時": ":", "时": ":", "分": ":", "秒": " "})
HALVES = re.compile(
    r"\s*\b(?:([ap])\.\s?m\b\.?)|\s*(?:(上午|午前|오전|π\.?μ\.?)|(下午|午後|오후|μ\.?μ\.?))\s*", re.IGNORECASE
)
HOUR = re.compile(r"(?<!\d)\d{1,2}:\d\d(:\d\d([.,]\d+)?)?")
TAIL = re.compile(r"\s*(Uhr|\[[\w/+-]+\]|\([^()]*\))$|\s?(UTC|GMT)(?=[+-]\d)")
OF = re.compile(r"(?<=\w )(de|del) (?=\w)")
DAY = re.compile(r"^(\d{1,2})\. ?(?=[^\W\d_])")
AT = re.compile(r",? (?:klo|kl\.?|um|à|at|ore|alle|г\.,?) (?=\d)|, (?=\d)")  # between the date and the time
HOURS = re.compile(r"(?<![\d:.])(\d{1,2}) ?h ?(\d\d)(?: ?m(?:in)? ?(\d\d) ?s?)?(?!\w)", re.IGNORECASE)
POINTS = re.compile(r"(?<=\d )(\d{1,2})\.(\d\d)(?:\.(\d\d(?:\.\d+)?))?(?![\d.:])")
ORDINAL = re.compile(r"^(\d{4})[-/.: ](\d{3})(?:[-:T ]+(?=\d)|$)", re.ASCII)  # a year and a day of it
YEAR_POINT = re.compile(r"^(\d{4})\. ?(\d{1,2})\. ?(\d{1,2})\. ")


def plain_date(stamp: str) -> str:
    """A stamp without its day of the week, with an English month, the year beside it, and its offset behind the time.

    "Thu Nov 26 21:00:00 CET 2026" becomes "Nov 26 2026 21:00:00+0100", "02. März 2026 um 06.00" "02 Mar 2026 06:00",
    "2/3/2026, 9:00 p. m." "2/3/2026 9:00 PM", "2024-366T22:00" "2024-12-31 22:00".
    """
    if stamp[5:8].isdecimal():
        stamp = ORDINAL.sub(_day_of_year, stamp)
    words = any(map(str.isalpha, stamp))
    if words:
        stamp = HOURS.sub(_with_colons, TAIL.sub("", stamp))
    if words or ", " in stamp:
        stamp = AT.sub(" ", stamp)
    if ". " in stamp:
        stamp = YEAR_POINT.sub(r"\1-\2-\3 ", stamp)
    if "." in stamp.partition(" ")[2]:
        stamp = POINTS.sub(_with_colons, stamp)
    if not words:
        return OFFSET.sub(r"\1\2", stamp) if " +" in stamp or " -" in stamp else stamp
    half = HALVES.search(stamp)
    if half:
        name = "AM" if half[2] or (half[1] or "").casefold() == "a" else "PM"
        around = f"{stamp[: half.start()]} {stamp[half.end() :]}".strip()
        stamp = HOUR.sub(lambda hour: f"{hour[0]} {name}", around, count=1)
    if "年" in stamp:
        return " ".join(stamp.translate(KANJI).split()).rstrip(":")
    stamp = OF.sub("", stamp)
    first = WEEKDAY.match(stamp)
    rest = stamp[first.end() :] if first else ""
    if first and not (first[2] and _month(first[1]) and not any(map(_month, MONTH.findall(rest)))):
        stamp = rest  # "martes 16 abril", but not "mar 16"
    stamp = JOINED.sub(r"\1 \2", DAY.sub(r"\1 ", stamp))
    stamp = MONTH.sub(lambda found: _month(found.group(1)) or found.group(0), stamp)
    stamp = ZONE.sub(lambda found: " " + ZONES[found.group(1)], stamp)
    moved = YEAR_LAST.match(stamp)
    if moved:
        stamp = f"{moved[1]} {moved[4]} {moved[2]} {moved[3] or ''}".strip()
    return OFFSET.sub(r"\1\2", stamp)


def _day_of_year(found: re.Match[str]) -> str:
    year, day = int(found[1]), int(found[2])
    if year == 0 or not 0 < day <= 365 + isleap(year):
        return found[0]
    moment = date(year, 1, 1) + timedelta(days=day - 1)
    return f"{moment} " if found.end() < len(found.string) else f"{moment}"


def _with_colons(time: re.Match[str]) -> str:
    return ":".join(field for field in time.groups() if field)


def _month(word: str) -> str | None:
    letters = word.casefold()
    if letters in ("am", "pm"):
        return None
    return BY_LETTERS.get(letters[:4]) or BY_LETTERS.get(letters[:3])
