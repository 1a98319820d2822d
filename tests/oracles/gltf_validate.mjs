// Khronos glTF-Validator on files that Centaur wrote, and three.js, which must find the meshes and the points that a document has.
// Needs `npm install gltf-validator three` in this folder or above.
// Usage: node gltf_validate.mjs FILE.glb …      Exit code 1 if a file has an error that is ours, or is not loaded as it should be.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import * as three from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
import { MeshoptDecoder } from 'three/examples/jsm/libs/meshopt_decoder.module.js';

globalThis.self = globalThis;
const validator = createRequire(import.meta.url)('gltf-validator');
// The validator takes any attribute with a `:` for malformed (KhronosGroup/glTF-Validator issue 252).
const prefixed = /\/attributes\/(KHR_gaussian_splatting|EXT_gaussian_splatting_hybrid):/;
const isKnown = (m) => m.code === 'MESH_PRIMITIVE_INVALID_ATTRIBUTE' && prefixed.test(m.pointer);

// Triangles and points of what stands in the scene.
function wanted({ scene = 0, scenes, nodes, meshes = [], accessors }) {
  const sums = { triangles: 0, points: 0 };
  const visit = (i) => {
    for (const p of meshes[nodes[i].mesh]?.primitives ?? []) {
      if (p.mode === 0) sums.points += accessors[p.attributes.POSITION].count;
      else sums.triangles += accessors[p.indices].count / 3;
    }
    nodes[i].children?.forEach(visit);
  };
  scenes[scene].nodes.forEach(visit);
  return sums;
}

let failed = false;
for (const file of process.argv.slice(2)) {
  const bytes = new Uint8Array(readFileSync(file));
  const { issues } = await validator.validateBytes(bytes, { uri: file, maxIssues: 0 });
  const errors = issues.messages.filter((m) => m.severity === 0 && !isKnown(m));
  const known = issues.messages.filter(isKnown).length;
  failed ||= errors.length > 0 || issues.truncated;
  console.log(`${file}: ${errors.length} errors, ${known} prefixed attributes, ${issues.numWarnings} warnings, ${issues.numInfos} infos`);
  for (const m of errors) console.log(`  error ${m.code} ${m.pointer}: ${m.message}`);
  const others = new Set(issues.messages.filter((m) => m.severity === 1 || m.severity === 2).map((m) => m.code));
  console.log(`  other codes: ${[...others].join(', ')}`);

  // three.js, with no extension of ours installed: the core fallback must load. Images need a browser and are replaced.
  const loader = new GLTFLoader();
  loader.setMeshoptDecoder(MeshoptDecoder);
  loader.register((parser) => ({ name: 'NO_IMAGES', loadTexture: async () => { parser; return new three.Texture(); } }));
  const gltf = await loader.parseAsync(bytes.buffer, '');
  const found = { triangles: 0, points: 0 };
  gltf.scene.traverse((o) => {
    if (o.isPoints) found.points += o.geometry.attributes.position.count;
    else if (o.isMesh) found.triangles += o.geometry.index.count / 3;
  });
  const expected = wanted(gltf.parser.json);
  const same = JSON.stringify(found) === JSON.stringify(expected);
  failed ||= !same;
  console.log(`  three.js ${three.REVISION}: ${JSON.stringify(found)}${same ? '' : `, expected ${JSON.stringify(expected)}`}`);
}
process.exit(failed ? 1 : 0);
