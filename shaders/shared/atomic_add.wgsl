// add_$TARGET(i, value): atomic addition to element i of the f32 buffer $TARGET at binding $BINDING.
// WGSL has no f32 atomics; where the adapter lacks the native extension, compare-exchange on the bits does the same.
//#if FLOAT_ATOMICS
@group(0) @binding($BINDING) var<storage, read_write> $TARGET: array<atomic<f32>>;

fn add_$TARGET(i: u32, value: f32) {
    atomicAdd(&$TARGET[i], value);
}
//#else
@group(0) @binding($BINDING) var<storage, read_write> $TARGET: array<atomic<u32>>;

fn add_$TARGET(i: u32, value: f32) {
    if value == 0.0 { return; }
    var old = atomicLoad(&$TARGET[i]);
    loop {
        let exchange = atomicCompareExchangeWeak(&$TARGET[i], old, bitcast<u32>(bitcast<f32>(old) + value));
        if exchange.exchanged { break; }
        old = exchange.old_value;
    }
}
//#end
