// The 3-D filter of Mip-Splatting: the standard deviation of the Gaussian with which a splat is smoothed so that it has
// no detail that no training view could have sampled. It is √0.2 times the least size of a pixel, z/f, at its mean,
// over the views that have the mean in front and within 15 % of the image around it. Splats that no view sees take the
// largest deviation of the others. f is that of the view itself, where Mip-Splatting's code takes the largest of all
// views: a view of shorter focal length samples more coarsely at the same distance. For captures with one camera the
// result is the same.
//
// One thread per splat, 12 multiply-adds per view; run now and then. 48 bytes read per splat, 4 written.

//#import shared/view.wgsl

struct Run {
    n_splats: u32,
    n_views: u32,
    near: f32,
    unused: u32,
}

struct TrainingView {
    row_x: vec4f,                       // world→camera
    row_y: vec4f,
    row_z: vec4f,
    low: vec2f,                         // least x/z and y/z
    high: vec2f,                        // and greatest
    focal: vec4f,                       // x: the longer one, pixels
}

@group(0) @binding(0) var<uniform> run: Run;
@group(0) @binding(1) var<storage, read> views: array<TrainingView>;
@group(0) @binding(2) var<storage, read_write> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> largest: atomic<u32>;        // bits of the largest deviation

const SAMPLING: f32 = 0.4472136;        // √0.2

@compute @workgroup_size(256)
fn measure(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= run.n_splats { return; }
    let mean = vec4f(geometry[3u * i].xyz, 1.0);
    var least = 3e38;
    for (var v = 0u; v < run.n_views; v++) {
        let z = dot(views[v].row_z, mean);
        let slope = vec2f(dot(views[v].row_x, mean), dot(views[v].row_y, mean)) / z;
        if z > run.near && all(slope >= views[v].low) && all(slope <= views[v].high) {
            least = min(least, z / views[v].focal.x);
        }
    }
    let deviation = select(0.0, SAMPLING * least, least < 3e38);
    geometry[3u * i + 2u].w = deviation;
    atomicMax(&largest, bitcast<u32>(deviation));
}

@compute @workgroup_size(256)
fn complete(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i < run.n_splats && geometry[3u * i + 2u].w == 0.0 {
        geometry[3u * i + 2u].w = bitcast<f32>(atomicLoad(&largest));
    }
}
