// Lists visible splats with their depth as sort key. z > near > 0, so float bits order like depths; counting from
// `near` leaves 28 significant bits for every depth up to 2³² · near. Near planes of other programs may be practically
// 0: keys count from at least LEAST_DEPTH. For finished scenes render/gpu/unit.rs defines it, for depths up to 43,000
// units, and renders scenes that are too small or too large for the keys in another unit. In training the near plane is
// fitted to the scene, and LEAST_DEPTH only keeps it positive.
//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> splats: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= view.n_splats || visible[i] == 0u { return; }
    let first = bitcast<u32>(max(view.near, LEAST_DEPTH));
    keys[slots[i]] = min(max(bitcast<u32>(projected[3u * i].z), first) - first, 0x0fffffffu);
    splats[slots[i]] = i;
}
