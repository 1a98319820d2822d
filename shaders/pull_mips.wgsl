// One thread per float of level `map.level`: adds a quarter of its parent's gradient. Run from the coarsest level but
// one down to level 1; adam_texels does level 0 in passing. 8 bytes read, 4 written.

//#import shared/view.wgsl
//#import shared/map.wgsl

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<storage, read_write> gradient: array<f32>;

@compute @workgroup_size(256)
fn pull(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let width = map.width >> map.level;
    if i >= width * (map.height >> map.level) * map.channels { return; }
    let parent = parent_of(map, map.level, i);
    gradient[level_offset(map, map.level) + i] += 0.25 * gradient[parent];
}
