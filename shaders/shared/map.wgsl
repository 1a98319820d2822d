// One texture of one mesh, as the kernels that run over its texels see it: a mip pyramid in a buffer of floats.

struct Map {
    offset: u32,        // of level 0, floats
    width: u32,         // of level 0, texels
    height: u32,
    levels: u32,
    channels: u32,      // floats per texel
    moments: u32,       // of level 0 in the buffer of moments, pairs
    level: u32,         // that the kernel writes
    is_base: u32,       // 1: DC and opacity, 0: bands
}

// Offset of a level. Every level is exactly a quarter of the one before: a geometric series.
fn level_offset(map: Map, level: u32) -> u32 {
    let texels = map.width * map.height - (map.width >> level) * (map.height >> level);
    return map.offset + texels / 3u * 4u * map.channels;
}
