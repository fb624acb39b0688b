//! The regions of a volume's voxels, cropped to the non-empty part plus a rim of one voxel.

use nalgebra::Matrix3;
use palpate_tissue::Vec3;
use rayon::prelude::*;

use crate::labels::{Affine, LabelVolume};

/// A voxel of no region.
pub(super) const OUTSIDE: u8 = 0;

/// A voxel beyond the volume's border. It is outside too, but the border is a separate plane: the image ends
/// there, not the body, and the cut stays flat with a sharp rim.
pub(super) const BEYOND: u8 = u8::MAX;

/// Least Dice coefficient of each region's voxels and its blocks for which voxels are joined. A region of 3 or 4 blocks
/// has about as much; a thinner layer would lose more in its blocks than in its smooth surface.
const JOINED_DICE_MIN: f64 = 0.95;
/// Block size in voxels above which the size is halved after a failed attempt; below it decreases by one.
const FACTOR_FINE: usize = 8;

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
    /// Copies the voxels of all regions and one voxel around them.
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

    /// Joins blocks of voxels into one that belongs to the region with most of them, as long as no block is
    /// longer than `finest_m` and every region keeps its place ([`JOINED_DICE_MIN`]). Returns the number of voxels per
    /// block, too.
    pub(super) fn coarsened(self, finest_m: f64, regions: usize) -> (Self, usize) {
        let spacing = self.to_world.spacing_m();
        let most = self.size.map(|n| n - 2);
        let mut factors: [usize; 3] =
            std::array::from_fn(|a| ((finest_m / spacing[a]) as usize).clamp(1, most[a].max(1)));
        let before = self.counts(regions);
        while factors != [1; 3] {
            let coarse = self.joined(factors);
            let each: usize = factors.iter().product();
            let common = self.common(&coarse, factors, regions);
            let after = coarse.counts(regions);
            let keeps = |r: usize| {
                let both = before[r] as f64 + (after[r] * each as u64) as f64;
                2.0 * common[r] as f64 >= JOINED_DICE_MIN * both
            };
            if (0..regions).all(keeps) {
                return (coarse, each);
            }
            // Large blocks shrink faster: a spacing in the wrong unit would otherwise take one pass over all
            // voxels per size.
            factors = factors.map(|f| {
                if f > FACTOR_FINE {
                    f / 2
                } else {
                    (f - 1).max(1)
                }
            });
        }
        (self, 1)
    }

    fn joined(&self, factors: [usize; 3]) -> Self {
        let inner = self.size.map(|n| n - 2);
        let index = |p: [usize; 3]| p[0] + self.size[0] * (p[1] + self.size[1] * p[2]);
        // The rims along an axis, relative to the first voxel.
        let rim = |a: usize, at: usize| {
            let mut p = [1; 3];
            p[a] = at;
            self.regions[index(p)]
        };
        let rims: [[u8; 2]; 3] = std::array::from_fn(|a| [rim(a, 0), rim(a, inner[a] + 1)]);
        let size: [usize; 3] = std::array::from_fn(|a| {
            let (n, f) = (inner[a], factors[a]);
            // The border of the image moves by half a block at most; nothing else is cropped.
            let blocks = if rims[a][1] == BEYOND {
                (n + f / 2) / f
            } else {
                n.div_ceil(f)
            };
            blocks.max(1) + 2
        });
        let mut regions = vec![OUTSIDE; size.iter().product()];
        regions
            .par_chunks_mut(size[0] * size[1])
            .enumerate()
            .for_each(|(z, layer)| {
                for (n, region) in layer.iter_mut().enumerate() {
                    let at = [n % size[0], n / size[0], z];
                    let outer = (0..3).find_map(|a| match at[a] {
                        0 => Some(rims[a][0]),
                        i if i + 1 == size[a] => Some(rims[a][1]),
                        _ => None,
                    });
                    *region = outer.unwrap_or_else(|| self.commonest(at, factors));
                }
            });
        let linear = self.to_world.linear;
        let first = Vec3::from_fn(|a, _| (1.0 - factors[a] as f64) / 2.0);
        Self {
            size,
            regions,
            to_world: Affine {
                linear: Matrix3::from_fn(|r, c| linear[(r, c)] * factors[c] as f64),
                origin: self.to_world.world(&first),
            },
        }
    }

    /// Voxels of each region that lie in a block of the same region.
    fn common(&self, coarse: &Self, factors: [usize; 3], regions: usize) -> Vec<u64> {
        let inner = self.size.map(|n| n - 1);
        let block = |a: usize, at: usize| ((at - 1) / factors[a] + 1).min(coarse.size[a] - 1);
        let layers = (1..inner[2]).into_par_iter().map(|z| {
            let mut common = [0; 256];
            let (own, joined) = (self.layer(z), coarse.layer(block(2, z)));
            for (y, x) in (1..inner[1]).flat_map(|y| (1..inner[0]).map(move |x| (y, x))) {
                let region = own[x + self.size[0] * y];
                let same = joined[block(0, x) + coarse.size[0] * block(1, y)] == region;
                common[usize::from(region)] += u64::from(same);
            }
            common
        });
        let sum = |a: [u64; 256], b: [u64; 256]| std::array::from_fn(|r| a[r] + b[r]);
        layers.reduce(|| [0; 256], sum)[1..=regions].to_vec()
    }

    /// The region with most voxels of a block; at equal numbers the later one, as in a scene.
    fn commonest(&self, at: [usize; 3], factors: [usize; 3]) -> u8 {
        let range = |a: usize| {
            let from = 1 + (at[a] - 1) * factors[a];
            from..(from + factors[a]).min(self.size[a] - 1)
        };
        let mut counts = [0_u32; 256];
        for z in range(2) {
            for y in range(1) {
                for x in range(0) {
                    let n = x + self.size[0] * (y + self.size[1] * z);
                    counts[usize::from(self.regions[n])] += 1;
                }
            }
        }
        let last = (0..=u8::MAX).max_by_key(|r| counts[usize::from(*r)]);
        last.unwrap_or(OUTSIDE)
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

/// Index in the volume of the voxel `at - 1` steps from the first one.
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
