// Babylon.js on files that Centaur wrote: its own loader must find the meshes and the splats that the document has.
// Needs `npm install @babylonjs/core @babylonjs/loaders` in this folder or above.
// Usage: node gltf_babylon.mjs FILE.glb …      Exit code 1 if a file is not loaded as it should be.
import { readFileSync } from 'node:fs';

// Splats are sorted in a worker, which node does not have in the browser's form, and no picture is asked for.
globalThis.Worker = class { postMessage() {} terminate() {} addEventListener() {} };
const { NullEngine } = await import('@babylonjs/core/Engines/nullEngine.js');
const { Scene } = await import('@babylonjs/core/scene.js');
const { LoadAssetContainerAsync } = await import('@babylonjs/core/Loading/sceneLoader.js');
const { Engine } = await import('@babylonjs/core/Engines/engine.js');
await import('@babylonjs/loaders/glTF/2.0/index.js');

const document = (bytes) => JSON.parse(bytes.subarray(20, 20 + bytes.readUInt32LE(12)).toString());

let failed = false;
for (const file of process.argv.slice(2)) {
  const bytes = readFileSync(file);
  const { meshes = [], accessors = [] } = document(bytes);
  const primitives = meshes.flatMap((mesh) => mesh.primitives);
  const isSplats = (p) => p.extensions?.KHR_gaussian_splatting !== undefined;
  const wanted = {
    // Babylon.js pads to blocks of 16.
    splats: primitives.filter(isSplats).reduce((sum, p) => sum + 16 * Math.ceil(accessors[p.attributes.POSITION].count / 16), 0),
    triangles: primitives.filter((p) => !isSplats(p)).reduce((sum, p) => sum + accessors[p.indices].count / 3, 0),
  };
  const scene = new Scene(new NullEngine());
  const url = `data:model/gltf-binary;base64,${bytes.toString('base64')}`;
  const container = await LoadAssetContainerAsync(url, scene, { pluginExtension: '.glb' });
  const isSplatMesh = (mesh) => mesh.getClassName() === 'GaussianSplattingMesh';
  const found = {
    splats: container.meshes.filter(isSplatMesh).reduce((sum, mesh) => sum + mesh.splatCount, 0),
    triangles: container.meshes.filter((mesh) => !isSplatMesh(mesh)).reduce((sum, mesh) => sum + mesh.getTotalIndices() / 3, 0),
  };
  const same = JSON.stringify(found) === JSON.stringify(wanted);
  failed ||= !same;
  console.log(`${file}: Babylon.js ${Engine.Version}: ${JSON.stringify(found)}${same ? '' : `, expected ${JSON.stringify(wanted)}`}`);
  scene.dispose();
}
process.exit(failed ? 1 : 0);
