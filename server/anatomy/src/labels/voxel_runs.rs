//! The regions of the voxels of a label volume, run by run.

use super::{Affine, LabelVolume};

/// Voxels of one region in a row along i.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VoxelRun {
    /// The region.
    pub region: u8,
    /// The first voxel, and one past the last.
    pub range: [u32; 2],
}

/// The region of every voxel, as runs: a hundredth of the memory of the volume.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelRuns {
    /// Voxels along each axis.
    pub size: [usize; 3],
    /// From voxel indices to the world.
    pub to_world: Affine,
    /// First run of each row, rows along j fastest, and one past the last run.
    start: Vec<u32>,
    runs: Vec<VoxelRun>,
}

impl VoxelRuns {
    /// The runs of a volume; `region_of` has a region number plus one, or 0, for each label.
    pub(super) fn new(volume: &LabelVolume, region_of: &[u8]) -> Self {
        let mut this = Self {
            size: volume.size,
            to_world: volume.to_world,
            start: vec![0],
            runs: Vec::new(),
        };
        for row in volume.labels.chunks(volume.size[0]) {
            let mut from = 0;
            for same in
                row.chunk_by(|a, b| region_of[usize::from(*a)] == region_of[usize::from(*b)])
            {
                let to = from + same.len() as u32;
                if let Some(region) = region_of[usize::from(same[0])].checked_sub(1) {
                    let range = [from, to];
                    this.runs.push(VoxelRun { region, range });
                }
                from = to;
            }
            this.start.push(this.runs.len() as u32);
        }
        this
    }

    /// The runs of the row at j and k.
    pub fn row(&self, [j, k]: [usize; 2]) -> &[VoxelRun] {
        let row = j + self.size[1] * k;
        &self.runs[self.start[row] as usize..self.start[row + 1] as usize]
    }
}
