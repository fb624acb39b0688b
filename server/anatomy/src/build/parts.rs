//! The closed parts of an input surface.

use std::sync::atomic::{AtomicBool, Ordering};

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::inside::PointQuery;
use super::interfaces::halve;
use crate::surface::Sets;
use crate::{Aabb, Surface};

/// Longest side, in spacings, of a piece of a wall that one probe stands for: as dense as the rays that find components.
const PIECE_SIDE: f64 = 1.0 / 3.0;
/// Probes of a small part, at least.
const PROBES_MIN: f64 = 64.0;
/// Distance of the probes behind and before a wall, in spacings.
const LOOK: f64 = 1e-3;

/// The closed parts of a surface; parts share no vertex.
pub(super) struct ClosedParts {
    /// The box around each part.
    pub(super) boxes: Vec<Aabb>,
    /// The part of each triangle.
    pub(super) of_triangle: Vec<u32>,
}

impl ClosedParts {
    pub(super) fn of(surface: &Surface) -> Self {
        let mut sets = Sets::new(surface.vertices.len());
        for &[a, b, c] in &surface.triangles {
            sets.join(a, b);
            sets.join(b, c);
        }
        let mut slot = vec![u32::MAX; surface.vertices.len()];
        let mut boxes: Vec<Aabb> = Vec::new();
        let mut part = |triangle: &[u32; 3]| {
            let slot = &mut slot[sets.find(triangle[0]) as usize];
            for at in triangle.map(|v| surface.vertices[v as usize]) {
                if *slot == u32::MAX {
                    *slot = boxes.len() as u32;
                    boxes.push(Aabb { min: at, max: at });
                }
                let own = &mut boxes[*slot as usize];
                own.min = own.min.inf(&at);
                own.max = own.max.sup(&at);
            }
            *slot
        };
        let of_triangle = surface.triangles.iter().map(&mut part).collect();
        Self { boxes, of_triangle }
    }

    /// For each part `in_doubt`, whether the region lies behind all of its wall, and not before it. Later regions and other
    /// parts of the region cover the rest of a wall.
    pub(super) fn are_whole(
        &self,
        surface: &Surface,
        region: usize,
        in_doubt: &[bool],
        (query, spacing): (&PointQuery, f64),
    ) -> Vec<bool> {
        let vector = |[a, b, c]: &[Vec3; 3]| (b - a).cross(&(c - a)) / 2.0;
        let area = |t: usize| vector(&surface.corners(t)).norm();
        let mut areas = vec![0.0; self.boxes.len()];
        // The area of a part before each triangle: every share of it gets a probe, however fine its triangles are.
        let before: Vec<f64> = (self.of_triangle.iter().enumerate())
            .map(|(t, &part)| {
                let before = areas[part as usize];
                areas[part as usize] += area(t);
                before
            })
            .collect();
        let covered = in_doubt.iter().map(|doubt| AtomicBool::new(!doubt));
        let covered: Vec<AtomicBool> = covered.collect();
        (0..before.len()).into_par_iter().for_each(|t| {
            let part = self.of_triangle[t] as usize;
            let corners = surface.corners(t);
            let Some(normal) = vector(&corners).try_normalize(0.0) else {
                return;
            };
            let side = (PIECE_SIDE * spacing).min((areas[part] / PROBES_MIN).sqrt());
            let share = |area: f64| (area / (side * side)).floor();
            let is_due = before[t] == 0.0 || share(before[t]) < share(before[t] + area(t));
            if !is_due || covered[part].load(Ordering::Relaxed) {
                return;
            }
            let look = normal * (LOOK * spacing);
            let mut stack = vec![corners];
            while let Some(piece) = stack.pop() {
                if let Some(halves) = halve(&piece, side) {
                    stack.extend(halves);
                    continue;
                }
                let at = (piece[0] + piece[1] + piece[2]) / 3.0;
                let is_behind = query.region_at(at - look) == Some(region);
                if !is_behind || query.contains(region, at + look) {
                    return covered[part].store(true, Ordering::Relaxed);
                }
            }
        });
        covered.into_iter().map(|c| !c.into_inner()).collect()
    }
}
