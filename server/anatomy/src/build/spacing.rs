//! Finding the spacing from the input: `Δd = max(d_min, d_threshold)` (Lin 2007, eq. 3.2).
//!
//! `d_min` is the smallest distance between intersections with different interfaces. On real data the plain
//! minimum is meaningless: surfaces that cross or end in one plane come arbitrarily close, and some ray
//! measures it. So `d_min` is a low quantile ([`QUANTILE`]) of the distances along rays in three directions.
//! Where surfaces coincide there is no layer, so distances below [`COINCIDENT`] are left out (reconstructed).
//! The report includes the plain minimum.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::label::Sweep;
use super::rays::{Hits, Rays, cast};
use super::{BUILD_NODES_MAX, GRID_CELLS_MAX, SpacingReport};
use crate::{Aabb, Surface};

/// Rays across the longest side of the input. Finer rays find no further layers, only more samples.
const RAYS: f64 = 128.0;
/// Part of the distances that may be smaller than the spacing.
const QUANTILE: f64 = 0.05;
/// Interfaces closer together than this, in m, coincide.
const COINCIDENT: f64 = 5e-5;
/// Cells across the smallest side of an input without layers.
const CELLS_ACROSS: f64 = 16.0;
/// Most nodes of a model with automatic spacing, unless the scene gives a least spacing: the size whose
/// equilibrium is solved within a tick.
const AUTO_NODES_MAX: f64 = 1e6;

/// The spacing in m and how it was found; `threshold` is `d_threshold` in m, 0 for none.
pub(super) fn find(surfaces: &[&Surface], threshold: f64) -> (f64, SpacingReport) {
    let bounds = Aabb::around(surfaces.iter().flat_map(|s| &s.vertices));
    let (low, extent) =
        bounds.map_or_else(|| (Vec3::zeros(), Vec3::zeros()), |b| (b.min, b.extent()));
    let step = extent.max() / RAYS;
    let mut distances: Vec<f64> = (0..3)
        .flat_map(|axis| distances_along(surfaces, axis, &low, &extent, step))
        .collect();
    distances.sort_unstable_by(f64::total_cmp);
    let smallest = distances.first().copied().unwrap_or(0.0);
    let layers = &distances[distances.partition_point(|d| *d < COINCIDENT)..];
    let quantile = if layers.is_empty() {
        extent.min() / CELLS_ACROSS
    } else {
        layers[((layers.len() - 1) as f64 * QUANTILE) as usize]
    };
    let volume = surfaces.iter().map(|s| s.volume()).fold(0.0, f64::max);
    let nodes_max = if threshold > 0.0 {
        BUILD_NODES_MAX
    } else {
        AUTO_NODES_MAX
    };
    let by_nodes = (volume / nodes_max).cbrt();
    let by_cells = (extent.add_scalar(4.0 * by_nodes).product() / GRID_CELLS_MAX).cbrt();
    let memory = by_nodes.max(by_cells) * 1.02;
    // Rounded up to the hundredth of a millimetre, so that reports and scenes hold the same number.
    let spacing = (quantile.max(threshold).max(memory) * 1e5).ceil() / 1e5;
    let report = SpacingReport {
        distances: distances.len(),
        smallest_mm: smallest * 1e3,
        quantile_mm: quantile * 1e3,
        quantile: QUANTILE,
        threshold_mm: threshold * 1e3,
        memory_mm: memory * 1e3,
    };
    (spacing, report)
}

/// Thickness along rays of every stretch between two different interfaces.
fn distances_along(
    surfaces: &[&Surface],
    axis: usize,
    low: &Vec3,
    extent: &Vec3,
    step: f64,
) -> Vec<f64> {
    let across = [(axis + 1) % 3, (axis + 2) % 3];
    let rays = Rays {
        axis,
        first: across.map(|a| low[a] + step / 2.0),
        step,
        count: across.map(|a| ((extent[a] / step).ceil() as usize).max(1)),
    };
    let hits: Vec<Hits> = surfaces.iter().map(|s| cast(s, &rays)).collect();
    (0..rays.count[1])
        .into_par_iter()
        .flat_map_iter(|row| {
            let mut sweep = Sweep::default();
            let mut found = Vec::new();
            let mut stretches: Vec<(usize, f64, f64)> = Vec::new();
            for column in 0..rays.count[0] {
                stretches.clear();
                sweep.resolve(&hits, rays.index([column, row]), |region, from, to| {
                    // The ray's stretches are split where a hidden surface crosses.
                    match stretches.last_mut() {
                        Some(last) if last.0 == region && last.2 == from => last.2 = to,
                        _ => stretches.push((region, from, to)),
                    }
                });
                for (at, &(_, from, to)) in stretches.iter().enumerate() {
                    let before = at.checked_sub(1).map(|b| stretches[b]);
                    let before = before.filter(|b| b.2 == from).map(|b| b.0);
                    let after = stretches.get(at + 1).filter(|a| a.1 == to).map(|a| a.0);
                    if before != after {
                        found.push(to - from);
                    }
                }
            }
            found
        })
        .collect()
}
