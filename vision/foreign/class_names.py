"""Class names for files that have none: a text beside the file, or those of COCO."""

from __future__ import annotations

from pathlib import Path

from vision.text_file import read_text

_LARGEST_BYTES = 1 << 20
# The 80 classes of COCO's detection task in the order of their ids; the number is the id of 1..90.
_COCO = """1 person,2 bicycle,3 car,4 motorcycle,5 airplane,6 bus,7 train,8 truck,9 boat,10 traffic light,
11 fire hydrant,13 stop sign,14 parking meter,15 bench,16 bird,17 cat,18 dog,19 horse,20 sheep,21 cow,
22 elephant,23 bear,24 zebra,25 giraffe,27 backpack,28 umbrella,31 handbag,32 tie,33 suitcase,34 frisbee,
35 skis,36 snowboard,37 sports ball,38 kite,39 baseball bat,40 baseball glove,41 skateboard,42 surfboard,
43 tennis racket,44 bottle,46 wine glass,47 cup,48 fork,49 knife,50 spoon,51 bowl,52 banana,53 apple,
54 sandwich,55 orange,56 broccoli,57 carrot,58 hot dog,59 pizza,60 donut,61 cake,62 chair,63 couch,
64 potted plant,65 bed,67 dining table,70 toilet,72 tv,73 laptop,74 mouse,75 remote,76 keyboard,77 cell phone,
78 microwave,79 oven,80 toaster,81 sink,82 refrigerator,84 book,85 clock,86 vase,87 scissors,88 teddy bear,
89 hair drier,90 toothbrush"""
COCO_IDS: dict[int, str] = {
    int(number): name for number, _, name in (entry.strip().partition(" ") for entry in _COCO.split(","))
}
COCO_NAMES: tuple[str, ...] = tuple(COCO_IDS.values())


class NamesError(ValueError):
    """Class names that are missing or cannot be used; one line that names the file."""


def names_beside(path: Path, count: int | None) -> tuple[tuple[str, ...], str]:
    """(class names, where they are from) for a file of `count` classes that does not name them.

    `NAME.txt` beside `NAME.onnx` has one name a line; without it 80 classes are COCO's, and 91 are COCO's by
    id, of which 11 are unused (`unused 0`, …). A file that does not state its number of classes, None, has as
    many as `NAME.txt`; without it COCO's 80 are assumed.

    Raises:
        NamesError: no names, another number of them, or a text that cannot be read.
    """
    beside = path.with_suffix(".txt")
    if beside.is_file():
        names = _names_in(beside)
        if not names or count not in (None, len(names)):
            raise NamesError(f"{beside}: has {len(names)} names, {path.name} has {count or 'some'} classes")
        return names, beside.name
    if count is None:
        return COCO_NAMES, f"COCO, assumed; if it is of other classes, write them into {beside.name}"
    if count == len(COCO_NAMES):
        return COCO_NAMES, "COCO, as it has 80 classes"
    if count == max(COCO_IDS) + 1:
        names = tuple(COCO_IDS.get(number, f"unused {number}") for number in range(count))
        return names, "COCO's ids, as it has 91 classes"
    raise NamesError(
        f"{path}: does not name its {count} classes; write them, one a line, into {beside.name} beside it"
    )


def _names_in(path: Path) -> tuple[str, ...]:
    try:
        if (size := path.stat().st_size) > _LARGEST_BYTES:
            raise NamesError(f"{path}: has {size} bytes, the limit is {_LARGEST_BYTES}")
        lines = read_text(path).splitlines()
    except OSError as error:
        raise NamesError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise NamesError(f"{path}: {error}; expected one name a line") from None
    names = tuple(line.strip() for line in lines if line.strip())
    for name in names:
        if not name.isprintable():
            raise NamesError(f"{path}: the name {name!r:.100} is not printable")
    return names
