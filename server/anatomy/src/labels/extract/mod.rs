//! From a label volume to one closed surface per region, without gaps or overlaps.
//!
//! 0. Voxels much finer than the requested size are joined in blocks ([`voxel_grid`]).
//! 1. Every corner where eight voxels of more than one region meet becomes a vertex, and every face between
//!    voxels of two regions a quadrilateral ([`net`]). All regions share this one mesh (surface nets, Gibson 1998,
//!    for several labels at once). Where a layer of one voxel is connected through edges only, each of its two
//!    sides has its own vertex ([`fans`]).
//! 2. Vertices slide towards their neighbours, each within half a voxel of its corner; vertices where three
//!    regions meet slide along that line only. This smooths the voxel steps ([`smooth`]).
//! 3. All vertices move along their normals so that every region regains the volume of its voxels. A vertex
//!    belongs to all regions around it, so this is one system of equations ([`restore`]).
//! 4. Each region takes its quadrilaterals as triangles ([`shell`]). Neighbours share their vertices bit for
//!    bit.

mod fans;
mod net;
mod restore;
mod shell;
mod smooth;
#[cfg(test)]
mod tests;
mod voxel_grid;

use std::path::Path;

use rayon::prelude::*;

use super::{LabelVolume, VoxelRuns};
use crate::scene::REGIONS_MAX;
use crate::{InputError, Surface};
pub use net::NET_VERTICES_MAX;
use net::Net;
use voxel_grid::{BEYOND, Grid, OUTSIDE};

/// The labels that make one region.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelRegion {
    /// Labels, in any order. A label that several regions name belongs to the last of them.
    pub labels: Vec<u16>,
}

/// The extracted surface of one region.
#[derive(Debug, Clone, PartialEq)]
pub struct RegionSurface {
    /// Closed, its edges shared by two triangles each, wound outwards; world coordinates in m.
    pub surface: Surface,
    /// Volume of the region's own voxels in m³, without other regions that the surface encloses.
    pub voxels_m3: f64,
    /// The regions on the two sides of each triangle of the surface.
    pub sides: Vec<Sides>,
}

/// The regions on the two sides of a triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sides {
    /// Behind it: the region of this surface, or one of several regions that the surface encloses.
    pub behind: u8,
    /// Before it; `None` outside all regions.
    pub before: Option<u8>,
}

/// Extracts the surfaces of `regions` from a volume that was read from `path` (for messages only).
///
/// With `wrap`, the first surface goes around all regions together instead of the first alone: a
/// builder in which later regions override earlier ones wants an outermost surface that contains
/// the others.
///
/// Voxels smaller than `finest_m` are joined into larger ones, at most that long, unless a region loses too
/// much volume. Details below the lattice spacing would only cost time. With 0 no voxels are joined.
///
/// # Panics
/// When there are more regions than a scene may have.
pub fn surfaces(
    volume: &LabelVolume,
    path: &Path,
    regions: &[LabelRegion],
    wrap: bool,
    finest_m: f64,
) -> Result<Vec<RegionSurface>, InputError> {
    assert!(
        regions.len() <= REGIONS_MAX,
        "more regions than a scene has"
    );
    let region_of = region_of(volume, path, regions)?;
    let grid = Grid::new(volume, &region_of);
    let voxels = grid.counts(regions.len());
    if let Some(r) = voxels.iter().position(|n| *n == 0) {
        let labels: Vec<String> = regions[r].labels.iter().map(u16::to_string).collect();
        let what = format!(
            "later regions take every voxel of label {}, none is left; give each region a label of its own",
            labels.join(", ")
        );
        return Err(InputError::of(path, what));
    }
    let (grid, joined) = grid.coarsened(finest_m, regions.len());
    let mut net = Net::of(&grid, path)?;
    drop(grid);
    let targets: Vec<f64> = voxels.iter().map(|n| *n as f64 / joined as f64).collect();
    smooth::smooth(&mut net, &targets);
    restore::restore(&mut net, &targets);
    let found = (0..regions.len()).into_par_iter().map(|r| {
        let (surface, sides) = if wrap && r == 0 {
            shell::shell(&net, |id| id != OUTSIDE && id != BEYOND)
        } else {
            shell::shell(&net, |id| usize::from(id) == r + 1)
        };
        RegionSurface {
            surface,
            sides,
            voxels_m3: voxels[r] as f64 * volume.voxel_m3(),
        }
    });
    Ok(found.collect())
}

/// The voxels of `regions` in a volume that was read from `path` (for messages only).
pub fn voxel_runs(
    volume: &LabelVolume,
    path: &Path,
    regions: &[LabelRegion],
) -> Result<VoxelRuns, InputError> {
    Ok(VoxelRuns::new(volume, &region_of(volume, path, regions)?))
}

/// Region number plus one for each label, or [`OUTSIDE`]; labels that do not occur are rejected.
fn region_of(
    volume: &LabelVolume,
    path: &Path,
    regions: &[LabelRegion],
) -> Result<Vec<u8>, InputError> {
    let counts = volume.counts();
    let mut region_of = vec![OUTSIDE; usize::from(u16::MAX) + 1];
    for (r, region) in regions.iter().enumerate() {
        for &label in &region.labels {
            if counts.binary_search_by_key(&label, |c| c.0).is_err() {
                let present = volume.present();
                let what = format!("label {label} does not occur; the volume holds {present}");
                return Err(InputError::of(path, what));
            }
            region_of[usize::from(label)] = r as u8 + 1;
        }
    }
    Ok(region_of)
}
