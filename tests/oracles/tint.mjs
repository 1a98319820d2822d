// Kernels by Tint, the compiler of WGSL in Chrome and in whatever else is made of Dawn, which is stricter than naga: with what tests on
// software adapters compile, `CENTAUR_WGSL=FOLDER cargo test --lib -- render::gpu`. Needs no GPU; `npm install webgpu` in this folder or above.
// Usage: node tint.mjs FOLDER      Exit code 1 if Tint refuses a kernel, or Dawn a pipeline of one that every WebGPU adapter has bindings for.
import { readFileSync, readdirSync } from 'node:fs';
import { join } from 'node:path';
import { create } from 'webgpu';

// What browsers want before subgroup operations, and naga does not know (gfx-rs/wgpu#5555). Tint takes what is behind `subgroupAny`, or a
// number from workgroup memory, for another in every lane, wherever that came from; naga looks at barriers alone.
const HEAD = 'enable subgroups;\ndiagnostic(off, subgroup_uniformity);\n';

const gpu = create(['backend=null']);           // Dawn crashes where this is collected before its devices
const adapter = await gpu.requestAdapter();
const device = await adapter.requestDevice({ requiredFeatures: ['subgroups'] });
const most = device.limits.maxStorageBuffersPerShaderStage;

// What was refused at `run`, in a line, or nothing.
async function refused(run) {
  device.pushErrorScope('validation');
  run();
  const error = await device.popErrorScope();
  return error && error.message.replace(/\s+/g, ' ').slice(0, 400);
}

const folder = process.argv[2];
const files = readdirSync(folder).filter((name) => name.endsWith('.wgsl')).sort();
const kernels = new Set();
const bound = new Map();
let failed = 0;
for (const name of files) {
  const [stem, entryPoint] = name.split('-');
  const text = readFileSync(join(folder, name), 'utf8');
  let module;
  let why = await refused(() => { module = device.createShaderModule({ code: /\bsubgroup/.test(text) ? HEAD + text : text }); });
  const buffers = text.match(/^@group\(0\) @binding\(\d+\) var<storage/gm)?.length ?? 0;
  // For software adapters uniforms are storage, too.
  if (buffers > most && text.includes('var<uniform>')) bound.set(stem, Math.max(buffers, bound.get(stem) ?? 0));
  if (buffers <= most) why ??= await refused(() => device.createComputePipeline({ layout: 'auto', compute: { module, entryPoint } }));
  kernels.add(`${stem}:${entryPoint}`);
  if (why) {
    failed += 1;
    console.log(`MISS ${name}: ${why}`);
  }
}
const more = [...bound].map(([stem, buffers]) => `${stem} ${buffers}`).join(', ');
console.log(`${kernels.size} kernels in ${files.length} variants, ${failed} refused; more than the ${most} storage buffers that WebGPU promises: ${more || 'none'}`);
process.exitCode = failed > 0 || files.length === 0 ? 1 : 0;
device.destroy();
