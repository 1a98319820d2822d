// Index of this thread's workgroup in a dispatch that may be folded into rows of WIDEST. Does not use num_workgroups,
// which is zero in indirect dispatches on DX12 unless the driver interface validates them.
fn group_index(group: vec3u) -> u32 {
    return group.x + group.y * WIDEST;
}
