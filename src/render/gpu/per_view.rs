//! Per-view parameters (exposures, poses) optimised by Adam: a few numbers for every view of a capture, two moments of
//! each, a count of steps. Only those of training views change.

use super::{
    adam::bias_corrections,
    device::{Buffer, Gpu, GpuError},
};

/// `N` numbers for each of V views, with their Adam state.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct PerView<const N: usize> {
    /// Values, `[V·N]`.
    pub(crate) values: Vec<f32>,
    /// First and second moments, laid out as the values.
    pub(crate) moments: [Vec<f32>; 2],
    /// Steps so far, `[V]`.
    pub(crate) steps: Vec<u32>,
}

impl<const N: usize> PerView<N> {
    /// The same initial numbers for each of `views` views.
    pub(crate) fn beginning_at(values: [f32; N], views: usize) -> Self {
        let zeros = || vec![0.0; N * views];
        Self { values: values.repeat(views), moments: [zeros(), zeros()], steps: vec![0; views] }
    }

    /// Whether all arrays have the lengths for this many views.
    pub(crate) fn is_of(&self, views: usize) -> bool {
        let is_full = |floats: &Vec<f32>| floats.len() == N * views;
        is_full(&self.values) && self.moments.iter().all(is_full) && self.steps.len() == views
    }
}

/// The same state on the GPU, except step counts, which the host keeps.
pub(super) struct PerViewBuffers<const N: usize> {
    pub(super) values: Buffer,
    pub(super) moments: [Buffer; 2],
    steps: Vec<u32>,
    /// Views of the steps not yet known to have been taken, in order; `None` for a step that counts for no view.
    unsettled: Vec<Option<usize>>,
}

impl<const N: usize> PerViewBuffers<N> {
    /// # Errors
    /// If the adapter has no memory left.
    pub(super) fn new(gpu: &Gpu, name: &str, state: &PerView<N>) -> Result<Self, GpuError> {
        let moment = |i: usize| gpu.storage_with(&format!("{name}, moment {}", i + 1), &state.moments[i]);
        Ok(Self {
            values: gpu.storage_with(name, &state.values)?,
            moments: [moment(0)?, moment(1)?],
            steps: state.steps.clone(),
            unsettled: vec![],
        })
    }

    /// Counts a step of a view, provisionally until [`Self::settle`]. Without `moves` it counts for none. Returns the
    /// words of Adam's bias correction.
    pub(super) fn count(&mut self, view: usize, moves: bool) -> [u32; 2] {
        self.steps[view] = self.steps[view].saturating_add(u32::from(moves));
        self.unsettled.push(moves.then_some(view));
        bias_corrections(self.steps[view]).map(f32::to_bits)
    }

    /// Takes back the last `skipped` of the steps counted since the last call: they changed nothing, and will be
    /// repeated and counted then.
    pub(super) fn settle(&mut self, skipped: u32) {
        let taken = self.unsettled.len().saturating_sub(skipped as usize);
        for view in self.unsettled.drain(..).skip(taken).flatten() {
            self.steps[view] = self.steps[view].saturating_sub(1);
        }
    }

    /// Reads the whole state. Waits.
    ///
    /// # Errors
    /// If the driver failed.
    pub(super) fn read(&self, gpu: &Gpu) -> Result<PerView<N>, GpuError> {
        let read = |buffer: &Buffer| gpu.read(buffer, N * self.steps.len());
        let [first, second] = &self.moments;
        let (values, moments) = (read(&self.values)?, [read(first)?, read(second)?]);
        Ok(PerView { values, moments, steps: self.steps.clone() })
    }

    /// Replaces the state by one of as many views.
    pub(super) fn write(&mut self, gpu: &Gpu, state: &PerView<N>) {
        gpu.write(&self.values, 0, &state.values);
        self.moments.iter().zip(&state.moments).for_each(|(buffer, values)| gpu.write(buffer, 0, values));
        self.steps.clone_from(&state.steps);
        self.unsettled.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_that_were_skipped_do_not_count() {
        let gpu = Gpu::open(None).unwrap();
        let mut views = PerViewBuffers::new(&gpu, "views", &PerView::beginning_at([0.5], 3)).unwrap();
        let first = views.count(0, true);
        assert_ne!(first, views.count(0, true), "another correction");
        for (view, moves) in [(1, true), (2, false), (0, true), (2, true)] {
            views.count(view, moves);
        }
        // The last three steps changed nothing, and one of them belonged to no view.
        views.settle(3);
        assert_eq!(views.read(&gpu).unwrap(), PerView { steps: vec![2, 1, 0], ..PerView::beginning_at([0.5], 3) });
        views.count(2, true);
        views.settle(0);
        views.settle(1);
        assert_eq!(views.read(&gpu).unwrap().steps, [2, 1, 1], "what was taken is taken");
    }
}
