"""A torus with normals, UVs, a rotating node and a morph target: the input of gltfpack and glTF-Transform for
tests/data/meshopt."""
import json, math, struct, base64
R, r, n, m = 1.0, 0.25, 24, 12
pos, nor, uv, idx, delta = [], [], [], [], []
for i in range(n + 1):
    for j in range(m + 1):
        u, v = 2*math.pi*i/n, 2*math.pi*j/m
        nx, ny, nz = math.cos(v)*math.cos(u), math.cos(v)*math.sin(u), math.sin(v)
        pos.append(((R+r*math.cos(v))*math.cos(u), (R+r*math.cos(v))*math.sin(u), r*math.sin(v)))
        nor.append((nx, ny, nz)); uv.append((i/n, j/m)); delta.append((0.1*nx, 0.1*ny, 0.1*nz))
for i in range(n):
    for j in range(m):
        a, b, c, d = i*(m+1)+j, (i+1)*(m+1)+j, (i+1)*(m+1)+j+1, i*(m+1)+j+1
        idx += [a, b, c, a, c, d]
times = [0.0, 1.0, 2.0]
rots = [(0,0,0,1), (0,0,math.sin(.7),math.cos(.7)), (0,0,math.sin(1.2),math.cos(1.2))]
blob, views, accs = b"", [], []
def add(rows, fmt, ct, typ, target=None, bounds=False):
    global blob
    blob += b"\0" * (-len(blob) % 4)
    data = b"".join(struct.pack("<"+fmt*len(row), *row) for row in rows)
    view = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)}
    if target: view["target"] = target
    views.append(view); blob += data
    acc = {"bufferView": len(views)-1, "componentType": ct, "type": typ, "count": len(rows)}
    if bounds:
        acc["min"] = [min(x) for x in zip(*rows)]; acc["max"] = [max(x) for x in zip(*rows)]
    accs.append(acc); return len(accs)-1
f32 = lambda rows: [tuple(struct.unpack("<f", struct.pack("<f", x))[0] for x in row) for row in rows]
P = add(f32(pos), "f", 5126, "VEC3", 34962, True); N = add(nor, "f", 5126, "VEC3", 34962); T = add(uv, "f", 5126, "VEC2", 34962)
I = add([(x,) for x in idx], "H", 5123, "SCALAR", 34963); D = add(f32(delta), "f", 5126, "VEC3", 34962, True)
K = add([(t,) for t in times], "f", 5126, "SCALAR", None, True); Q = add(rots, "f", 5126, "VEC4")
W = add([(0.0,), (1.0,), (0.5,)], "f", 5126, "SCALAR")
doc = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
  "nodes": [{"mesh": 0, "name": "torus", "translation": [0, 2, 0]}],
  "meshes": [{"primitives": [{"attributes": {"POSITION": P, "NORMAL": N, "TEXCOORD_0": T}, "indices": I, "material": 0, "targets": [{"POSITION": D}]}]}],
  "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}],
  "images": [{"uri": "data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="}],
  "animations": [{"samplers": [{"input": K, "output": Q}, {"input": K, "output": W}], "channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}, {"sampler": 1, "target": {"node": 0, "path": "weights"}}]}],
  "accessors": accs, "bufferViews": views,
  "buffers": [{"byteLength": len(blob), "uri": "data:application/octet-stream;base64," + base64.b64encode(blob).decode()}]}
json.dump(doc, open("torus.gltf", "w"))
