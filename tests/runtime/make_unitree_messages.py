"""Random messages, and what Unitree's own package makes of them, with which test_unitree_go2.py compares ours.

That package needs Python 3.10; no other is needed. Writes ``unitree_messages.json`` anew, in two minutes::

    python3.10 -m venv /tmp/oracle && /tmp/oracle/bin/pip install unitree_sdk2==1.0.1
    /tmp/oracle/bin/python tests/runtime/make_unitree_messages.py
"""

import hashlib
import itertools
import json
import math
import struct
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

FILE = Path(__file__).with_name("unitree_messages.json")
COUNT = 10_000  # messages of each type
WHOLE = 2  # of them, the first, are in the file as they are: they show where others differ
SPECIAL = (math.nan, math.inf, -math.inf, 0.0, -0.0, 2.0**-149, -(2.0**-149), 2.0**128 - 2.0**104)
"""Take the place of random numbers that are not a number; random bits hardly ever make the others."""
CODES = {"uint8": "B", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "float32": "f"}


def messages(codes):
    """Yield the numbers of COUNT messages, of the types that struct calls ``codes``: the same on every Python."""
    layout, special = struct.Struct("<" + codes), itertools.cycle(SPECIAL)
    for numbers in layout.iter_unpack(hashlib.shake_256(codes.encode()).digest(COUNT * layout.size)):
        yield [next(special) if math.isnan(number) else number for number in numbers]


def summary(messages):
    """Return digests of messages, each its bytes and its CRC, and some of them whole."""
    whole, digests = [], {"bytes": hashlib.sha256(), "crcs": hashlib.sha256()}
    for data, crc in messages:
        digests["bytes"].update(data)
        digests["crcs"].update(crc.to_bytes(4, "little"))
        if len(whole) < WHOLE:
            whole.append([data.hex(), crc])
    return {"whole": whole} | {name: digest.hexdigest() for name, digest in digests.items()}


def type_id(kind):
    """Return the hash of a type that DDS's two sides compare."""
    return kind.__idl__.get_type_info().complete.typeid_with_size.type_id.value.hex()


def build(kind, take):
    """Return a message of Unitree's type, or a part of one, made of what ``take`` returns for the type of a number."""
    if isinstance(kind, str):
        module, _, name = kind.rpartition(".")
        kind = getattr(sys.modules[module], name)
    [kind] = getattr(kind, "__metadata__", [kind])
    if isinstance(kind, str):
        return take(kind)
    if hasattr(kind, "subtype"):
        return [build(kind.subtype, take) for _ in range(kind.length)]
    return kind(*[build(member, take) for member in kind.__annotations__.values()])


def random_messages(kind):
    """Yield Unitree's messages of random numbers."""
    codes = []
    build(kind, lambda name: codes.append(CODES[name]))
    for row in messages("".join(codes)):
        numbers = iter(row)
        yield build(kind, lambda _, numbers=numbers: next(numbers))


def main():
    """Write the file."""
    sys.modules["unitree_sdk2py.b2"] = ModuleType("b2")  # the package imports it, the wheel lacks it
    from unitree_sdk2py.idl.unitree_api.msg.dds_ import Request_, Response_
    from unitree_sdk2py.idl.unitree_go.msg.dds_ import LowCmd_, LowState_
    from unitree_sdk2py.utils.crc import CRC

    with patch("platform.system", return_value="no Linux"):  # there it loads a library, which the wheel lacks, too
        crc = CRC()
    name = "_CRC__packFmtLowState"  # gives signs to bytes and to a fan's speed, whose types have none: half are refused
    setattr(crc, name, getattr(crc, name).replace("b", "B").replace("4h2I", "4H2I"))
    found = {"types": {kind.__name__: type_id(kind) for kind in (LowCmd_, LowState_, Request_, Response_)}}
    for kind in (LowCmd_, LowState_):
        made = ((message.serialize(), crc.Crc(message)) for message in random_messages(kind))
        found[kind.__name__] = summary(made)
    FILE.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
