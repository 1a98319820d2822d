// Khronos glTF-Validator on files that Centaur wrote. Needs `npm install gltf-validator three` in this folder or above.
// Usage: node gltf_validate.mjs FILE.glb …      Exit code 1 if a file has an error that is ours.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';

const validator = createRequire(import.meta.url)('gltf-validator');
// The validator takes any attribute with a `:` for malformed (KhronosGroup/glTF-Validator issue 252).
const prefixed = /\/attributes\/(KHR_gaussian_splatting|EXT_gaussian_splatting_hybrid):/;
const isKnown = (m) => m.code === 'MESH_PRIMITIVE_INVALID_ATTRIBUTE' && prefixed.test(m.pointer);

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
  const three = await import('three').catch(() => null);
  if (!three) { console.log('  three.js is not installed: not loaded'); continue; }
  const { GLTFLoader } = await import('three/examples/jsm/loaders/GLTFLoader.js');
  globalThis.self = globalThis;
  const loader = new GLTFLoader();
  const { MeshoptDecoder } = await import('three/examples/jsm/libs/meshopt_decoder.module.js');
  loader.setMeshoptDecoder(MeshoptDecoder);
  loader.register((parser) => ({ name: 'NO_IMAGES', loadTexture: async () => { parser; return new three.Texture(); } }));
  const gltf = await loader.parseAsync(bytes.buffer, '');
  const kinds = {};
  gltf.scene.traverse((o) => { kinds[o.type] = (kinds[o.type] ?? 0) + 1; });
  console.log(`  three.js ${three.REVISION}: ${JSON.stringify(kinds)}`);
}
process.exit(failed ? 1 : 0);
