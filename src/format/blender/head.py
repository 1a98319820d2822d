import argparse
import contextlib
import json
import os
import shlex
import struct
import sys
import tempfile
import zlib

try:
    import bpy
    import numpy as np
    from mathutils import Matrix
except ImportError:
    bpy = np = None
