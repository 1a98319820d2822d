use std::collections::HashMap;

use fast_surface_nets::ndshape::{ConstShape, ConstShape3u32};
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::fusion::{Block, Fusion, LEAST_VIEWS, SIDE};
use super::surface::Surface;

/// A block padded by one sample of each neighbour: samples −1..=8 in its own numbering.
type Padded = ConstShape3u32<10, 10, 10>;

/// Triangles of one block. Vertices are identified by their cell, so that neighbouring blocks agree on them.
struct Patch {
    cells: Vec<[i32; 3]>,
    positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
}

impl Fusion {
    /// Extracts the surface where the fused distance changes sign, counter-clockwise seen from outside; one vertex per
    /// grid cell that it passes (surface nets), shared across blocks. Cells with a corner that too few views have seen
    /// have no vertex: the surface ends there. The order of vertices and triangles depends on the views only. With a
    /// contraction the result lies in contracted space, where all voxels are alike.
    pub(super) fn extract(&self) -> Surface {
        let mut order: Vec<&Block> = self.blocks.iter().collect();
        order.par_sort_unstable_by_key(|b| b.key);
        let patches: Vec<Patch> =
            order.into_par_iter().map_init(SurfaceNetsBuffer::default, |buffer, b| self.patch(b, buffer)).collect();
        let mut index_of = HashMap::new();
        let mut surface = Surface::default();
        for patch in patches {
            let welded: Vec<u32> = patch
                .cells
                .iter()
                .zip(patch.positions)
                .map(|(&cell, position)| {
                    *index_of.entry(cell).or_insert_with(|| {
                        surface.positions.push(position);
                        surface.positions.len() as u32 - 1
                    })
                })
                .collect();
            surface.triangles.extend(patch.triangles.iter().map(|t| t.map(|v| welded[v as usize])));
        }
        surface
    }

    /// Maps a surface from contracted space back to the world.
    pub(super) fn expanded(&self, mut surface: Surface) -> Surface {
        if let Some(contraction) = &self.options.contraction {
            surface.positions.iter_mut().for_each(|p| *p = contraction.expand(p.as_dvec3()).as_vec3());
        }
        surface
    }

    fn patch(&self, block: &Block, buffer: &mut SurfaceNetsBuffer) -> Patch {
        // Unseen samples count as outside here; vertices that touch one are dropped below.
        let mut distance = [1.0_f32; Padded::USIZE];
        let mut seen = [false; Padded::USIZE];
        self.gather(block, &mut distance, &mut seen);
        surface_nets(&distance, &Padded {}, [0; 3], [9; 3], buffer);

        let mut patch = Patch { cells: Vec::new(), positions: Vec::new(), triangles: Vec::new() };
        let mut kept = vec![u32::MAX; buffer.positions.len()];
        let base = block.key.map(|k| k * SIDE - 1);
        for (i, (cell, position)) in buffer.surface_points.iter().zip(&buffer.positions).enumerate() {
            let complete = (0..8).all(|c| {
                seen[Padded::linearize([cell[0] + (c & 1), cell[1] + (c >> 1 & 1), cell[2] + (c >> 2)]) as usize]
            });
            if complete {
                kept[i] = patch.cells.len() as u32;
                patch.cells.push([0, 1, 2].map(|a| base[a] + cell[a] as i32));
                let grid = glam::IVec3::from_array(base).as_dvec3() + DVec3::from_array(position.map(f64::from));
                patch.positions.push((self.options.bounds.0 + grid * self.options.voxel).as_vec3());
            }
        }
        patch.triangles = buffer
            .indices
            .chunks_exact(3)
            .map(|t| [kept[t[0] as usize], kept[t[1] as usize], kept[t[2] as usize]])
            .filter(|t| !t.contains(&u32::MAX))
            .collect();
        patch
    }

    /// Copies the block and the adjacent layer of its 26 neighbours.
    fn gather(&self, block: &Block, distance: &mut [f32], seen: &mut [bool]) {
        for neighbor in 0..27 {
            let offset = [neighbor % 3 - 1, neighbor / 3 % 3 - 1, neighbor / 9 - 1];
            let key = [0, 1, 2].map(|a| block.key[a] + offset[a]);
            let Some(&slot) = self.slots.get(&key) else { continue };
            let voxels = &self.blocks[slot as usize].voxels;
            let range = |axis: usize| match offset[axis] {
                -1 => SIDE - 1..SIDE,
                0 => 0..SIDE,
                _ => 0..1,
            };
            for z in range(2) {
                for y in range(1) {
                    for x in range(0) {
                        let voxel = voxels[(x + SIDE * (y + SIDE * z)) as usize];
                        if voxel.views >= LEAST_VIEWS {
                            let [px, py, pz] = [x + 1, y + 1, z + 1];
                            let padded = [px + offset[0] * SIDE, py + offset[1] * SIDE, pz + offset[2] * SIDE];
                            let i = Padded::linearize(padded.map(|p| p as u32)) as usize;
                            distance[i] = voxel.distance;
                            seen[i] = true;
                        }
                    }
                }
            }
        }
    }
}
