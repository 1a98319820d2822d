//! What can go wrong on an adapter.

use crate::scene::SceneError;

/// A failure of the adapter or the driver.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// None that could run the pipeline.
    #[error(
        "no GPU adapter {}: install a Vulkan, Metal or DX12 driver; without a GPU, Mesa's software adapter works \
         (Debian/Ubuntu: apt install mesa-vulkan-drivers)",
        if unfit.is_empty() { "found".to_owned() } else { format!("will do ({})", unfit.join("; ")) }
    )]
    NoAdapter {
        /// Those that there are, and why each cannot.
        unfit: Vec<String>,
    },
    /// None of the requested name, index or PCI bus id.
    #[error("no adapter matches {wanted:?}; available: {available}")]
    NoSuchAdapter {
        /// What was asked for.
        wanted: String,
        /// All adapters, as they can be asked for.
        available: String,
    },
    /// The adapter refused a device.
    #[error("{adapter}: cannot open a device: {reason}")]
    Device {
        /// Adapter name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
    /// A buffer exceeds what the adapter can bind.
    #[error("{what} needs a buffer of {needed} MiB, but {adapter} binds at most {limit} MiB: {LESS}")]
    TooLarge {
        /// What the buffer holds.
        what: String,
        /// MiB asked for.
        needed: u64,
        /// MiB the adapter binds.
        limit: u64,
        /// Adapter name.
        adapter: String,
    },
    /// What is about to be allocated exceeds what is free.
    #[error("{what} needs {needed} MiB of memory, but {adapter} has {free} MiB free: {LESS}")]
    NotEnoughMemory {
        /// What the memory is for.
        what: String,
        /// MiB asked for.
        needed: u64,
        /// MiB that are free.
        free: u64,
        /// Adapter name.
        adapter: String,
    },
    /// The driver has no memory left.
    #[error("{adapter} is out of memory: no room for {what} beside the {held} MiB in use: {LESS}")]
    OutOfMemory {
        /// What there was no room for.
        what: String,
        /// MiB allocated before, without what the driver needs itself.
        held: u64,
        /// Adapter name.
        adapter: String,
    },
    /// More splats in a tile than loops of the adapter go through.
    #[error(
        "a tile of 16×16 pixels has {splats} splats, and {adapter} goes through {most} at most: expected a larger picture, fewer splats, or a GPU"
    )]
    TileTooFull {
        /// In the fullest tile.
        splats: usize,
        /// That the adapter can go through.
        most: usize,
        /// Adapter name.
        adapter: String,
    },
    /// No scene to render.
    #[error("the scene cannot be rendered: {0}")]
    Scene(#[from] SceneError),
    /// A camera of another size than a renderer was made for.
    #[error("expected a picture no larger than those that the renderer was made for, found {width}×{height}")]
    ImageTooLarge {
        /// Pixels across.
        width: u32,
        /// Pixels down.
        height: u32,
    },
    /// The driver reported an error while running.
    #[error("{adapter}: {reason}")]
    Failed {
        /// Adapter name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
}

/// How to get by with less memory.
pub(super) const LESS: &str =
    "smaller images, fewer mesh layers, smaller maps or fewer splats need less, whichever it holds";

impl GpuError {
    /// Whether a smaller scene or smaller images would help.
    #[must_use]
    pub fn is_lack_of_memory(&self) -> bool {
        matches!(self, Self::TooLarge { .. } | Self::NotEnoughMemory { .. } | Self::OutOfMemory { .. })
    }
}

/// An error outside a call that returns one.
#[derive(Clone)]
pub(super) enum Failure {
    OutOfMemory,
    Other(String),
}

impl From<wgpu::Error> for Failure {
    fn from(error: wgpu::Error) -> Self {
        match error {
            wgpu::Error::OutOfMemory { .. } => Self::OutOfMemory,
            other => Self::Other(other.to_string()),
        }
    }
}
