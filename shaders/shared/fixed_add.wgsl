// add_$TARGET(i, units): adds to element i of $TARGET at binding $BINDING, see fixed_point.wgsl.
@group(0) @binding($BINDING) var<storage, read_write> $TARGET: array<atomic<i32>>;

fn add_$TARGET(i: u32, units: f32) {
    atomicAdd(&$TARGET[i], i32(round(units)));
}
