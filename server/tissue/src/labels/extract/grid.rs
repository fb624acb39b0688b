//! The regions of a volume's voxels, cut down to where there are any, with a rim of one voxel.

use rayon::prelude::*;

use crate::Vec3;
use crate::labels::{Affine, LabelVolume};

/// A voxel of no region.
pub(super) const OUTSIDE: u8 = 0;

/// A voxel beyond the volume's border. It is outside too, but the border is a plane of its own: an
/// image ends there, not the body, and the cut stays flat with a sharp rim.
pub(super) const BEYOND: u8 = u8::MAX;

/// Regions of voxels, x fastest.
pub(super) struct Grid {
    /// Voxels along each axis, the rim included.
    pub(super) size: [usize; 3],
    /// Region number plus one, [`OUTSIDE`] or [`BEYOND`].
    pub(super) regions: Vec<u8>,
    /// From indices in this grid to the world.
    pub(super) to_world: Affine,
}

impl Grid {
    /// Takes over what lies in some region and one voxel around it.
    pub(super) fn new(volume: &LabelVolume, region_of: &[u8]) -> Self {
        let [low, high] = extent(volume, region_of);
        let size: [usize; 3] = std::array::from_fn(|a| high[a] - low[a] + 2);
        let [nx, ny, _] = size;
        let mut regions = vec![BEYOND; size.iter().product()];
        // Voxel `at` of the grid is voxel `at + low - 1` of the volume.
        regions
            .par_chunks_mut(nx * ny)
            .enumerate()
            .for_each(|(z, layer)| {
                let Some(k) = within(z + low[2], volume.size[2]) else {
                    return;
                };
                for (y, row) in layer.chunks_mut(nx).enumerate() {
                    let Some(j) = within(y + low[1], volume.size[1]) else {
                        continue;
                    };
                    let from = volume.size[0] * (j + volume.size[1] * k);
                    for (x, region) in row.iter_mut().enumerate() {
                        if let Some(i) = within(x + low[0], volume.size[0]) {
                            *region = region_of[usize::from(volume.labels[from + i])];
                        }
                    }
                }
            });
        let shift = Vec3::from_fn(|a, _| low[a] as f64 - 1.0);
        Self {
            size,
            regions,
            to_world: Affine {
                linear: volume.to_world.linear,
                origin: volume.to_world.world(&shift),
            },
        }
    }

    /// Voxels of each region.
    pub(super) fn counts(&self, regions: usize) -> Vec<u64> {
        let mut counts = [0_u64; 256];
        for region in &self.regions {
            counts[usize::from(*region)] += 1;
        }
        counts[1..=regions].to_vec()
    }

    /// The layer of voxels with index `z`.
    pub(super) fn layer(&self, z: usize) -> &[u8] {
        let area = self.size[0] * self.size[1];
        &self.regions[z * area..(z + 1) * area]
    }
}

/// Index in the volume of what is `at - 1` steps from its first voxel.
fn within(at: usize, size: usize) -> Option<usize> {
    at.checked_sub(1).filter(|i| *i < size)
}

/// First voxel in some region along each axis, and one past the last.
fn extent(volume: &LabelVolume, region_of: &[u8]) -> [[usize; 3]; 2] {
    let [nx, ny, _] = volume.size;
    let of_layer = |(k, layer): (usize, &[u16])| {
        let mut low = [usize::MAX; 3];
        let mut high = [0; 3];
        for (n, label) in layer.iter().enumerate() {
            if region_of[usize::from(*label)] != OUTSIDE {
                for (a, at) in [n % nx, n / nx, k].into_iter().enumerate() {
                    low[a] = low[a].min(at);
                    high[a] = high[a].max(at + 1);
                }
            }
        }
        [low, high]
    };
    let join = |a: [[usize; 3]; 2], b: [[usize; 3]; 2]| {
        [
            std::array::from_fn(|i| a[0][i].min(b[0][i])),
            std::array::from_fn(|i| a[1][i].max(b[1][i])),
        ]
    };
    let none = || [[usize::MAX; 3], [0; 3]];
    let [low, high] = volume
        .labels
        .par_chunks(nx * ny)
        .enumerate()
        .map(of_layer)
        .reduce(none, join);
    if low[0] == usize::MAX {
        return [[0; 3], [0; 3]];
    }
    [low, high]
}
