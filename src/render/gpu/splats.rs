//! Splats on the GPU: their parameters, and the stages from projection to visible splats sorted by depth.

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    geometry::{GEOMETRY_FLOATS, Geometry},
    scan::{DispatchSizes, Items, Scan},
    shader::Defines,
    sort::{self, Sort},
    tile_pairs::{COUNT_PAIRS, COUNT_SPLATS, COUNT_VISIBLE, InView, PER_GROUP, TilePairs},
    unit::LEAST_DEPTH,
    view::TILE,
};
use crate::render::contract::{ImageModel, ShDirection};
use crate::scene::{Camera, Splats, sh};

/// Bits of a depth key, see `compact_visible.wgsl`.
const DEPTH_BITS: u32 = 28;

/// [`LEAST_DEPTH`] of trainings, which have no unit of length: their near plane is fitted to the scene.
const LEAST_DEPTH_IN_TRAINING: f32 = 1e-30;

/// Splat parameters in the shaders' layout.
pub(crate) struct SplatBuffers {
    /// `[capacity][3]` vec4.
    pub(crate) geometry: Buffer,
    /// `[capacity][(d+1)²][3]`.
    pub(crate) sh: Buffer,
    pub(crate) capacity: usize,
    pub(crate) sh_degree: u32,
}

impl SplatBuffers {
    /// Buffers for up to `capacity` splats of a degree.
    pub(crate) fn new(gpu: &Gpu, capacity: usize, sh_degree: u32) -> Result<Self, GpuError> {
        let capacity = capacity.max(1);
        Ok(Self {
            geometry: gpu.storage("splat geometry", capacity * GEOMETRY_FLOATS)?,
            sh: gpu.storage("splat SH", capacity * 3 * sh::coefficients(sh_degree))?,
            capacity,
            sh_degree,
        })
    }

    /// Replaces the first splats by those of a scene; their number must not exceed the capacity.
    pub(crate) fn write(&self, gpu: &Gpu, splats: &Splats) {
        gpu.write(&self.geometry, 0, &pack_geometry(splats));
        gpu.write(&self.sh, 0, splats.sh());
    }
}

/// Adds the defines of `shaders/shared/sh_coefficients.wgsl` for splats of a degree.
pub(super) fn with_sh(defines: Defines, sh_degree: u32) -> Defines {
    let terms = sh::coefficients(sh_degree) as u32;
    let fours = (3 * terms).is_multiple_of(4);
    defines
        .with("SH_TERMS", terms)
        .with("FOURS", u32::from(fours))
        .with("SH_LOADS", if fours { 3 * terms / 4 } else { 3 * terms })
}

/// Geometry of splats in the layout of the geometry buffer, `[N·12]` floats.
pub(crate) fn pack_geometry(splats: &Splats) -> Vec<f32> {
    let mut out = Vec::with_capacity(splats.len() * GEOMETRY_FLOATS);
    for i in 0..splats.len() {
        let geometry = Geometry {
            mean: splats.means()[i],
            opacity_logit: splats.opacity_logits()[i],
            rotation: splats.rotations()[i],
            log_scale: splats.log_scales()[i],
            smoothing: 0.0,
        };
        out.extend(geometry.to_row());
    }
    out
}

/// Size of the largest image that buffers are made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ImageCapacity {
    pub(crate) pixels: usize,
    pub(crate) tiles: usize,
}

impl ImageCapacity {
    /// Capacity for images up to all of these (width, height) pairs.
    pub(crate) fn of(sizes: impl IntoIterator<Item = (u32, u32)>) -> Self {
        let mut most = Self { pixels: 1, tiles: 1 };
        for (w, h) in sizes {
            most.pixels = most.pixels.max(w as usize * h as usize);
            most.tiles = most.tiles.max(w.div_ceil(TILE) as usize * h.div_ceil(TILE) as usize);
        }
        most
    }

    /// Checks that a picture of this camera fits: the driver's own error would leave the device unusable.
    pub(crate) fn check(self, camera: &Camera) -> Result<(), GpuError> {
        let k = camera.intrinsics();
        let of = Self::of([(k.width, k.height)]);
        if of.pixels <= self.pixels && of.tiles <= self.tiles {
            return Ok(());
        }
        Err(GpuError::ImageTooLarge { width: k.width, height: k.height })
    }
}

/// Stages and buffers from splat parameters to tile lists.
pub(crate) struct SplatLists {
    /// Projected splats, `[capacity][3]` vec4, see `project_splats.wgsl`.
    pub(crate) projected: Buffer,
    /// Visibility, `[capacity]`: 1 if the splat touches a tile.
    pub(crate) visible: Buffer,
    /// Order thresholds, `[capacity][layers]`, see `order_splats.wgsl`; a dummy without layers.
    pub(crate) thresholds: Buffer,
    /// Splats in their own frames, `[capacity][5]` vec4, see `blend_rays.wgsl`; `None` under [`ImageModel::Ewa`].
    pub(crate) rays: Option<Buffer>,
    pub(crate) pairs: TilePairs,
    counts: Buffer,
    layers: u32,
    purpose: Purpose,
    depth_sort: Sort,
    find_visible: Scan,
    /// Dispatch sizes for the visible splats.
    sizes: DispatchSizes,
    project: Stage,
    compact: Stage,
    order: Option<Stage>,
    tile_count: Buffer,
}

/// Numbering of pairs for the summation of per-tile results of a splat: the pairs of a splat have consecutive numbers.
pub(crate) struct Numbers<'a> {
    /// `[pair]` vec2u, sorted by tile and depth: splat and number.
    pub(crate) pairs: &'a Buffer,
    /// See [`SplatLists::counts`].
    pub(crate) counts: &'a Buffer,
    /// Visible splats, by depth.
    pub(crate) splats: &'a Buffer,
    /// First number of each of these splats.
    pub(crate) first: &'a Buffer,
    /// Number of pairs, `[splat]`.
    pub(crate) count: &'a Buffer,
}

/// Purpose of [`SplatLists`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Pictures under this model.
    Render(ImageModel),
    /// Gradients under [`ImageModel::Ewa`] as well, using [`SplatLists::numbers`].
    Train,
}

/// Inputs of [`SplatLists`], and what the lists are for.
pub(crate) struct ListInputs<'a> {
    pub(crate) purpose: Purpose,
    pub(crate) splats: &'a SplatBuffers,
    pub(crate) image: ImageCapacity,
    /// The view's uniform.
    pub(crate) view: &'a Buffer,
    /// Depth of the mesh layers, and their number, if there are meshes that splats are ordered against by thresholds.
    pub(crate) layer_depth: Option<(&'a Buffer, u32)>,
}

/// Capacity for a list that was too short for `needed` entries: half as many again, within what the adapter binds and
/// 32 bits count.
pub(crate) fn longer_list(gpu: &Gpu, needed: usize) -> usize {
    needed.saturating_add(needed / 2).min(longest_list(gpu)).max(needed)
}

/// Most list entries that an adapter binds: in training eight bytes each, splat and number.
pub(crate) fn longest_list(gpu: &Gpu) -> usize {
    (gpu.max_binding_bytes() as usize / 8).min(u32::MAX as usize - 1)
}

impl SplatLists {
    /// Stages for these inputs, with room for this many pairs.
    ///
    /// # Errors
    /// If the adapter cannot hold the lists.
    pub(crate) fn new(gpu: &Gpu, inputs: &ListInputs, pair_capacity: usize) -> Result<Self, GpuError> {
        let &ListInputs { purpose, splats, image, view, layer_depth } = inputs;
        let n = splats.capacity;
        let (model, trains) = match purpose {
            Purpose::Render(model) => (model, false),
            Purpose::Train => (ImageModel::Ewa, true),
        };
        let projected = gpu.storage("projected splats", n * 12)?;
        let rays = match model {
            ImageModel::Ewa => None,
            ImageModel::Ray(_) => Some(gpu.storage("splat rays", n * 20)?),
        };
        let tile_count = gpu.storage("tile counts", n)?;
        let visible = gpu.storage("visible splats", n)?;
        let slots = gpu.storage("slots", n)?;
        let counts = gpu.storage("counts", 4)?;
        let layers = layer_depth.map_or(0, |l| l.1);
        let thresholds = gpu.storage("order thresholds", (n * layers as usize).max(1))?;

        let depth_sort = Sort::new(gpu, n, DEPTH_BITS, &counts, COUNT_VISIBLE)?;
        let find_visible = Scan::new(gpu, n, &visible, &slots, &counts, COUNT_SPLATS, COUNT_VISIBLE)?;
        let blocks = [PER_GROUP, sort::BLOCK, Scan::block(gpu)];
        let sizes = DispatchSizes::new(gpu, n, &blocks, &counts, COUNT_VISIBLE)?;

        let defines = with_sh(gpu.defines(), splats.sh_degree)
            .with("LAYERS", layers)
            .with("SH_BY_RAY", u32::from(model == ImageModel::Ray(ShDirection::Ray)));
        let stage = |file: &str, buffers: &[&Buffer]| Stage::new(gpu, file, "main", &defines, buffers);
        let mut parameters = vec![view, &splats.geometry, &splats.sh, &projected, &tile_count, &visible];
        let project = match &rays {
            None => stage("project_splats.wgsl", &parameters),
            Some(rays) => {
                parameters.push(rays);
                stage("project_rays.wgsl", &parameters)
            }
        };
        let least_depth = if trains { LEAST_DEPTH_IN_TRAINING } else { LEAST_DEPTH };
        let compact = Stage::new(
            gpu,
            "compact_visible.wgsl",
            "main",
            &gpu.defines().with_real("LEAST_DEPTH", least_depth.into()),
            &[view, &visible, &slots, &projected, depth_sort.keys_in(), depth_sort.values_in()],
        );
        let order =
            layer_depth.map(|(depth, _)| stage("order_splats.wgsl", &[view, &visible, &projected, depth, &thresholds]));
        let in_view = InView {
            view,
            counts: &counts,
            splats: depth_sort.values_out(),
            tile_count: &tile_count,
            projected: &projected,
        };
        let pairs = TilePairs::new(gpu, &in_view, (image.tiles, n), pair_capacity, trains)?;
        Ok(Self {
            projected,
            visible,
            thresholds,
            rays,
            pairs,
            counts,
            layers,
            purpose,
            depth_sort,
            find_visible,
            sizes,
            project,
            compact,
            order,
            tile_count,
        })
    }

    /// Appends projection, depth order, ordering against the mesh layers and tile lists of the first `n` splats.
    pub(crate) fn record(&self, gpu: &Gpu, frame: &mut Frame, n: usize) {
        gpu.write(&self.counts, 0, &[n as u32, 0, 0, 0]);
        frame.clear(&self.pairs.ranges);
        if n == 0 {
            return;
        }
        frame.dispatch_threads(&self.project, n);
        self.find_visible.record(frame, Items::Known(n));
        self.sizes.record(frame);
        frame.dispatch_threads(&self.compact, n);
        self.depth_sort.record(frame, &self.sizes);
        if let Some(order) = &self.order {
            frame.dispatch_threads(order, n);
        }
        self.pairs.record(frame, &self.sizes);
    }

    /// Pairs with their numbers, filled in training only.
    pub(crate) fn numbers(&self) -> Numbers<'_> {
        Numbers {
            pairs: &self.pairs.numbered,
            counts: &self.counts,
            splats: self.depth_sort.values_out(),
            first: &self.pairs.offsets,
            count: &self.tile_count,
        }
    }

    /// Counts of splats, visible splats, pairs, and pairs that fit.
    pub(crate) fn counts(&self) -> &Buffer {
        &self.counts
    }

    /// Number of mesh layers that splats are ordered against.
    pub(crate) fn layers(&self) -> u32 {
        self.layers
    }

    /// Purpose that the lists were made for.
    pub(crate) fn purpose(&self) -> Purpose {
        self.purpose
    }

    /// Number of splats in the fullest of the first `tiles` tiles in the last frame. Waits.
    pub(crate) fn longest(&self, gpu: &Gpu, tiles: usize) -> Result<usize, GpuError> {
        let ranges: Vec<[u32; 2]> = gpu.read(&self.pairs.ranges, tiles)?;
        Ok(ranges.iter().map(|[first, end]| end.saturating_sub(*first) as usize).max().unwrap_or(0))
    }

    /// Numbers of visible splats and of pairs in the last frame; more pairs than the capacity mean that the frame is
    /// incomplete.
    pub(crate) fn read_counts(&self, gpu: &Gpu) -> Result<(usize, usize), GpuError> {
        let counts: Vec<u32> = gpu.read(&self.counts, 4)?;
        Ok((counts[COUNT_VISIBLE as usize] as usize, counts[COUNT_PAIRS as usize] as usize))
    }
}
