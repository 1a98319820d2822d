//! Status of training steps, determined on the GPU: lets a step learn nothing from an incomplete image, although the
//! host looks only now and then (`shaders/check_lists.wgsl`, `shaders/shared/status.wgsl`).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    shader::Defines,
    splats::SplatLists,
    tile_pairs::COUNT_PAIRS,
};

/// Words of the buffer.
const WORDS: usize = 5;
/// Groups that may become non-finite: names of their bits in shaders, from the lowest on, and descriptions.
const NOT_FINITE: [(&str, &str); 7] = [
    ("NOT_FINITE_GEOMETRY", "splat geometry"),
    ("NOT_FINITE_SH", "SH coefficients"),
    ("NOT_FINITE_BASE", "a map of colour and opacity"),
    ("NOT_FINITE_BANDS", "a map of view dependence"),
    ("NOT_FINITE_VERTICES", "vertices of the mesh"),
    ("NOT_FINITE_EXPOSURES", "exposures of photographs"),
    ("NOT_FINITE_POSES", "poses of photographs"),
];

/// Adds the bits of [`NOT_FINITE`].
pub(super) fn with_not_finite(defines: Defines) -> Defines {
    NOT_FINITE.iter().enumerate().fold(defines, |defines, (bit, (name, _))| defines.with(name, 1 << bit))
}

/// A zeroed status buffer.
pub(crate) fn status_buffer(gpu: &Gpu) -> Result<Buffer, GpuError> {
    gpu.storage("step status", WORDS)
}

/// Status of the steps so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Status {
    /// Steps since [`Self::forget_skipped`] that changed nothing, because a list was too short for their view or for
    /// one before them.
    pub(crate) skipped: u32,
    /// Group of parameters or second moments that has become NaN or infinite, if any.
    pub(crate) not_finite: Option<&'static str>,
    /// Longest lists of (tile, splat) and (bin, triangle) pairs that any step needed.
    pub(crate) pairs: [usize; 2],
}

impl Status {
    /// Re-enables steps after lists have been enlarged.
    pub(crate) fn forget_skipped(gpu: &Gpu, buffer: &Buffer) {
        gpu.write(buffer, 0, &[0_u32; 2]);
    }

    /// Reads the status. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn read(gpu: &Gpu, buffer: &Buffer) -> Result<Self, GpuError> {
        let (buffer, count) = Self::words(buffer);
        Ok(Self::of(&gpu.read::<u32>(buffer, count)?))
    }

    /// The part of the buffer to read, for [`Self::of`].
    pub(crate) fn words(buffer: &Buffer) -> (&Buffer, usize) {
        (buffer, WORDS)
    }

    /// Status from its words.
    pub(crate) fn of(words: &[u32]) -> Self {
        let not_finite = NOT_FINITE.iter().enumerate().find(|(bit, _)| words[4] >> bit & 1 != 0);
        Self {
            skipped: words[1],
            not_finite: not_finite.map(|(_, (_, group))| *group),
            pairs: [words[2] as usize, words[3] as usize],
        }
    }
}

/// Stage that checks whether lists were too short.
pub(crate) struct ListCheck(Stage);

impl ListCheck {
    /// Check of these lists, and `MeshStage::pairs`; to be made anew whenever they are.
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

    /// Appends the check to a frame, after the lists.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch(&self.0, 1);
    }
}
