//! What a training step finds out about itself on the GPU, for a step that learns nothing from an incomplete image and for
//! a host that looks only now and then (`shaders/check_lists.wgsl`, `shaders/shared/status.wgsl`).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    mesh::MeshStage,
    splats::{COUNT_PAIRS, SplatLists},
};

/// Words of the buffer.
const WORDS: usize = 5;

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
        let words: Vec<u32> = gpu.read(buffer, WORDS)?;
        let groups = [
            "splat geometry",
            "SH coefficients",
            "a map of colour and opacity",
            "a map of view dependence",
            "vertices of the mesh",
            "exposures of photographs",
            "poses of photographs",
        ];
        let not_finite = groups.into_iter().enumerate().find(|(bit, _)| words[4] >> bit & 1 != 0);
        Ok(Self {
            skipped: words[1],
            not_finite: not_finite.map(|(_, group)| group),
            pairs: [words[2] as usize, words[3] as usize],
        })
    }
}

/// The stage that finds out whether lists were too short.
pub(crate) struct ListCheck(Stage);

impl ListCheck {
    /// For these lists; to be made anew when they are.
    pub(crate) fn new(gpu: &Gpu, view: &Buffer, lists: &SplatLists, mesh: Option<&MeshStage>, status: &Buffer) -> Self {
        let defines = gpu.defines().with("COUNT_PAIRS", COUNT_PAIRS).with("MESH", u32::from(mesh.is_some()));
        let mut buffers = vec![view, lists.counts(), status];
        buffers.extend(mesh.map(MeshStage::pairs).into_iter().flatten());
        Self(Stage::new(gpu, "check_lists.wgsl", "main", &defines, &buffers))
    }

    /// Appends it to a frame, behind the lists.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch(&self.0, 1);
    }
}
