"""Validates the JSON of .glb files against Khronos' own schema of glTF 2.0, as bundled with trimesh.

Usage: python check_gltf_schema.py FILE.glb ...      Exit code 1 if a file has a fault.
"""

import json
import struct
import sys

import jsonschema
from trimesh.exchange.gltf import get_schema


def document(path):
    with open(path, "rb") as file:
        data = file.read()
    magic, _, _, length, kind = struct.unpack("<4sII I4s", data[:20])
    assert (magic, kind) == (b"glTF", b"JSON"), path
    return json.loads(data[20 : 20 + length])


def main(paths):
    schema = get_schema()
    validator = jsonschema.validators.validator_for(schema)(schema)
    # The schema must be able to detect faults, otherwise finding none would mean nothing.
    planted = {"asset": {}, "accessors": [{"componentType": 5126, "count": 0, "type": "VEC3"}]}
    assert len(list(validator.iter_errors(planted))) == 2, "the schema passes a broken document"
    failed = False
    for path in paths:
        faults = list(validator.iter_errors(document(path)))
        failed = failed or bool(faults)
        print(f"{path}: {len(faults)} faults by {schema['title']}'s schema")
        for fault in faults[:10]:
            print(f"  {fault.json_path}: {fault.message[:200]}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
