//! Errors of adapters and drivers.

use crate::scene::SceneError;

/// A failure of the adapter or the driver.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No adapter can run the pipeline.
    #[error(
        "no GPU adapter {}: install a Vulkan, Metal or DX12 driver; without a GPU, Mesa's software adapter works \
         (Debian/Ubuntu: apt install mesa-vulkan-drivers)",
        if unfit.is_empty() { "found".to_owned() } else { format!("will do ({})", unfit.join("; ")) }
    )]
    NoAdapter {
        /// The adapters present, and why each cannot.
        unfit: Vec<String>,
    },
    /// No adapter of the requested name, index or PCI bus id.
    #[error("no adapter matches {wanted:?}; available: {available}")]
    NoSuchAdapter {
        /// The request.
        wanted: String,
        /// All adapters, as they can be requested.
        available: String,
    },
    /// The adapter refused a device.
    #[error("{adapter}: cannot open a device: {reason}")]
    Device {
        /// Adapter name.
        adapter: String,
        /// The driver's message.
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
    /// The memory about to be allocated exceeds what is free.
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
        /// What did not fit.
        what: String,
        /// MiB allocated before, without the driver's own.
        held: u64,
        /// Adapter name.
        adapter: String,
    },
    /// A tile has more splats than the adapter's loops can process.
    #[error(
        "a tile of 16×16 pixels has {splats} splats, and {adapter} goes through {most} at most: expected a larger picture, fewer splats, or a GPU"
    )]
    TileTooFull {
        /// Splats in the fullest tile.
        splats: usize,
        /// Splats that the adapter can process.
        most: usize,
        /// Adapter name.
        adapter: String,
    },
    /// The scene is not valid.
    #[error("the scene cannot be rendered: {0}")]
    Scene(SceneError),
    /// A camera is larger than the renderer was made for.
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
        /// The driver's message.
        reason: String,
    },
}

/// Advice on needing less memory.
pub(super) const LESS: &str =
    "smaller images, fewer mesh layers, smaller maps or fewer splats need less, whichever it holds";

impl GpuError {
    /// Whether a smaller scene or smaller images would help.
    #[must_use]
    pub fn is_lack_of_memory(&self) -> bool {
        matches!(self, Self::TooLarge { .. } | Self::NotEnoughMemory { .. } | Self::OutOfMemory { .. })
    }
}

/// An error outside of a call that returns one.
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
