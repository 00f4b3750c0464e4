"""JSON objects with a checksum as last entry, to see that they are as they were written."""

import re
import zlib

CHECKSUM = re.compile(rb',\s*"crc32": "([0-9a-f]{8})"\s*}\s*$')


def with_checksum(text: str) -> str:
    """Return the text of an object with a checksum."""
    body = text.rstrip().removesuffix("}").rstrip()
    if body == "{":
        return text
    return f'{body},\n "crc32": "{zlib.crc32(body.encode()):08x}"\n}}\n'


def without_checksum(content: bytes) -> bytes:
    """Return an object without its checksum; ValueError if it has one that does not fit."""
    found = CHECKSUM.search(content)
    if not found:  # from before there were any
        return content
    body = content[: found.start()]
    if zlib.crc32(body) != int(found[1], 16):
        raise ValueError("it is not as it was written")
    return body + b"}"
