//! Splats of a training: read, replaced, and rearranged, for which their buffers grow.

use super::{Training, new_moments, sh_floats};
use crate::render::gpu::{
    device::{Buffer, Frame, GpuError},
    geometry::GEOMETRY_FLOATS,
    memory::with_headroom,
    rows::{Rows, Source},
    splats::SplatBuffers,
    state::SplatState,
};

#[cfg(test)]
impl SplatState {
    /// [`Training::rearrange`] on the host.
    pub(crate) fn rearranged(&self, geometry: &[f32], sources: &[Source]) -> Self {
        let of_geometry = |before: &[f32]| Source::gather(sources, before, GEOMETRY_FLOATS, Rows::GeometryMoments);
        let of_sh = |before: &[f32], what| Source::gather(sources, before, self.sh_floats(), what);
        Self {
            sh_degree: self.sh_degree,
            geometry: geometry.to_vec(),
            sh: of_sh(&self.sh, Rows::Parameters),
            geometry_m: of_geometry(&self.geometry_m),
            geometry_v: of_geometry(&self.geometry_v),
            sh_m: of_sh(&self.sh_m, Rows::ShMoments),
            sh_v: of_sh(&self.sh_v, Rows::ShMoments),
        }
    }
}

impl Training<'_> {
    /// Reads parameters and moments of all splats. Waits.
    pub(crate) fn read_splats(&self) -> Result<SplatState, GpuError> {
        let (p, n) = (&self.pipeline.front, self.pipeline.front.n_splats);
        let [gm, gv, sm, sv] = &self.moments;
        let terms = sh_floats(&p.splats);
        let read = |buffer: &Buffer, width: usize| self.gpu.read::<f32>(buffer, n * width);
        Ok(SplatState {
            sh_degree: p.splats.sh_degree,
            geometry: read(&p.splats.geometry, GEOMETRY_FLOATS)?,
            sh: read(&p.splats.sh, terms)?,
            geometry_m: read(gm, GEOMETRY_FLOATS)?,
            geometry_v: read(gv, GEOMETRY_FLOATS)?,
            sh_m: read(sm, terms)?,
            sh_v: read(sv, terms)?,
        })
    }

    /// Reads the geometry of all splats, `[N·12]`. Waits.
    pub(crate) fn read_geometry(&self) -> Result<Vec<f32>, GpuError> {
        self.gpu.read(&self.pipeline.front.splats.geometry, self.pipeline.front.n_splats * GEOMETRY_FLOATS)
    }

    /// Replaces the geometry of all splats; each takes everything else from its source. Statistics are zeroed. Buffers
    /// that have room for more than [`TrainingOptions::most_splats`](super::TrainingOptions) are replaced by smaller
    /// ones. Waits only if buffers are replaced, or for more geometry than is uploaded at once.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn rearrange(&mut self, geometry: &[f32], sources: &[Source]) -> Result<(), GpuError> {
        let n = sources.len();
        assert_eq!(geometry.len(), n * GEOMETRY_FLOATS, "one source per splat");
        debug_assert!(sources.iter().all(|s| s.splat() < self.pipeline.front.n_splats), "sources are splats");
        if n > self.pipeline.front.splats.capacity {
            let [pairs, _] = self.list_lengths();
            self.reallocate(self.room_for(n), pairs)?;
        }
        let (p, [gm, gv, sm, sv]) = (&self.pipeline.front, &self.moments);
        // Gradients serve as scratch space, as the next step writes them before it reads them.
        let gradients = &self.backward.splats;
        let (scratch, sh_scratch) = (&gradients.geometry, &gradients.sh);
        let buffers = [
            (Rows::GeometryMoments, gm, scratch),
            (Rows::GeometryMoments, gv, scratch),
            (Rows::Parameters, &p.splats.sh, sh_scratch),
            (Rows::ShMoments, sm, sh_scratch),
            (Rows::ShMoments, sv, sh_scratch),
        ];
        self.rows.run(self.gpu, sources, &buffers)?;
        self.gpu.write(&p.splats.geometry, 0, geometry);
        let mut frame = Frame::new(self.gpu);
        frame.clear(&gradients.statistics);
        frame.submit();
        self.pipeline.front.n_splats = n;
        let capacity = self.pipeline.front.splats.capacity;
        let enough = capacity.min(self.most_splats).max(n);
        if enough == capacity {
            return Ok(());
        }
        // Fewer splats also have fewer pairs than the lists may have grown for.
        let [pairs, _] = self.list_lengths();
        self.reallocate(enough, (pairs as f64 * (enough as f64 / capacity as f64)) as usize)
    }

    /// Capacity of buffers for `n` splats.
    fn room_for(&self, n: usize) -> usize {
        with_headroom(self.gpu, n, self.pipeline.front.splats.sh_degree, self.most_splats)
    }

    /// Gives buffers room for `capacity` splats, no fewer than there are, and lists room for at least `pairs` pairs.
    /// Buffers that every step refills are freed first and reallocated last, so that the copying of parameters and
    /// moments in between peaks no higher than the larger allocation of the two. Waits.
    fn reallocate(&mut self, capacity: usize, pairs: usize) -> Result<(), GpuError> {
        let (gpu, sh_degree, n_splats) = (self.gpu, self.pipeline.front.splats.sh_degree, self.pipeline.front.n_splats);
        self.pipeline.front.n_splats = 0;
        let splats = self.pipeline.replace_splats(gpu, SplatBuffers::new(gpu, 0, sh_degree)?, 0)?;
        let moments = self.replace_moments(new_moments(gpu, &self.pipeline.front.splats)?);
        self.refresh()?;
        let others = SplatBuffers::new(gpu, capacity, sh_degree)?;
        let other_moments = new_moments(gpu, &others)?;
        let parameters = [(&splats.geometry, &others.geometry), (&splats.sh, &others.sh)];
        let mut frame = Frame::new(gpu);
        for (from, to) in parameters.into_iter().chain(moments.iter().zip(&other_moments)) {
            frame.copy(from, to);
        }
        frame.submit();
        drop((splats, moments));
        gpu.wait()?;
        self.pipeline.replace_splats(gpu, others, pairs)?;
        self.replace_moments(other_moments);
        self.refresh()?;
        self.pipeline.front.n_splats = n_splats;
        Ok(())
    }

    /// Replaces all splats. Statistics are zeroed.
    pub(crate) fn write_splats(&mut self, state: &SplatState) -> Result<(), GpuError> {
        let n = state.len();
        if n > self.pipeline.front.splats.capacity {
            let (sh_degree, room) = (self.pipeline.front.splats.sh_degree, self.room_for(n));
            // All data is on the host: the old buffers are freed first, so that both need not fit.
            let [pairs, _] = self.list_lengths();
            self.pipeline.front.n_splats = 0;
            for (capacity, pairs) in [(0, 0), (room, pairs)] {
                let splats = SplatBuffers::new(self.gpu, capacity, sh_degree)?;
                self.pipeline.replace_splats(self.gpu, splats, pairs)?;
                self.refresh()?;
                self.gpu.wait()?;
            }
        }
        self.pipeline.front.n_splats = n;
        let p = &self.pipeline.front;
        let [gm, gv, sm, sv] = &self.moments;
        let buffers = [&p.splats.geometry, &p.splats.sh, gm, gv, sm, sv];
        for (buffer, values) in buffers.into_iter().zip(state.arrays()) {
            self.gpu.write(buffer, 0, values);
        }
        self.write_statistics(&vec![0.0; 4 * n]);
        Ok(())
    }

    /// Reads the density statistics, `[N·4]`, see `splat_backward.wgsl`. Waits.
    pub(crate) fn read_statistics(&self) -> Result<Vec<f32>, GpuError> {
        self.gpu.read(&self.backward.splats.statistics, self.pipeline.front.n_splats * 4)
    }

    /// Replaces the density statistics.
    pub(crate) fn write_statistics(&self, statistics: &[f32]) {
        self.gpu.write(&self.backward.splats.statistics, 0, statistics);
    }
}
