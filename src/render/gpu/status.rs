//! What a training step finds out about itself on the GPU, for a step that learns nothing from an incomplete image and for
//! a host that looks only now and then (`shaders/check_lists.wgsl`, `shaders/shared/status.wgsl`).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    shader::Defines,
    splats::SplatLists,
    tile_pairs::COUNT_PAIRS,
};

/// Words of the buffer.
const WORDS: usize = 5;
/// What may cease to be finite: by the names of their bits in shaders, from the lowest on, and in words.
const NOT_FINITE: [(&str, &str); 7] = [
    ("NOT_FINITE_GEOMETRY", "splat geometry"),
    ("NOT_FINITE_SH", "SH coefficients"),
    ("NOT_FINITE_BASE", "a map of colour and opacity"),
    ("NOT_FINITE_BANDS", "a map of view dependence"),
    ("NOT_FINITE_VERTICES", "vertices of the mesh"),
    ("NOT_FINITE_EXPOSURES", "exposures of photographs"),
    ("NOT_FINITE_POSES", "poses of photographs"),
];

/// Adds these bits.
pub(super) fn with_not_finite(defines: Defines) -> Defines {
    NOT_FINITE.iter().enumerate().fold(defines, |defines, (bit, (name, _))| defines.with(name, 1 << bit))
}

/// A zeroed buffer for it.
pub(crate) fn status_buffer(gpu: &Gpu) -> Result<Buffer, GpuError> {
    gpu.storage("step status", WORDS)
}

/// The steps so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Status {
    /// Steps that changed nothing because a list was too short for their view or for one before them, since [`Self::forget_skipped`].
    pub(crate) skipped: u32,
    /// What has become NaN or infinite, if anything, parameters or second moments.
    pub(crate) not_finite: Option<&'static str>,
    /// Longest lists of (tile, splat) and (bin, triangle) pairs of any step.
    pub(crate) pairs: [usize; 2],
}

impl Status {
    /// Lets steps change things again, as lists are longer now.
    pub(crate) fn forget_skipped(gpu: &Gpu, buffer: &Buffer) {
        gpu.write(buffer, 0, &[0_u32; 2]);
    }

    /// Reads it. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read(gpu: &Gpu, buffer: &Buffer) -> Result<Self, GpuError> {
        let (buffer, count) = Self::words(buffer);
        Ok(Self::of(&gpu.read::<u32>(buffer, count)?))
    }

    /// The words of it that are to be read.
    pub(crate) fn words(buffer: &Buffer) -> (&Buffer, usize) {
        (buffer, WORDS)
    }

    /// What [`Self::words`] say.
    pub(crate) fn of(words: &[u32]) -> Self {
        let not_finite = NOT_FINITE.iter().enumerate().find(|(bit, _)| words[4] >> bit & 1 != 0);
        Self {
            skipped: words[1],
            not_finite: not_finite.map(|(_, (_, group))| *group),
            pairs: [words[2] as usize, words[3] as usize],
        }
    }
}

/// The stage that finds out whether lists were too short.
pub(crate) struct ListCheck(Stage);

impl ListCheck {
    /// For these lists, and `MeshStage::pairs`; to be made anew when they are.
    pub(crate) fn new(
        gpu: &Gpu,
        view: &Buffer,
        lists: &SplatLists,
        triangle_pairs: Option<[&Buffer; 2]>,
        status: &Buffer,
    ) -> Self {
        let has_mesh = triangle_pairs.is_some();
        let defines = gpu.defines().with("COUNT_PAIRS", COUNT_PAIRS).with("MESH", u32::from(has_mesh));
        let mut buffers = vec![view, lists.counts(), status];
        buffers.extend(triangle_pairs.into_iter().flatten());
        Self(Stage::new(gpu, "check_lists.wgsl", "main", &defines, &buffers))
    }

    /// Appends it to a frame, behind the lists.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch(&self.0, 1);
    }
}
