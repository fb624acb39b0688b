//! Findings and repairs of a check.

use super::Aabb;

/// The outcome of [`super::Surface::check`] on an accepted surface. Counts are of triangles unless stated
/// otherwise.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckReport {
    /// Closed parts that are not connected to each other.
    pub components: usize,
    /// Components that lie inside another one and face inward: cavities.
    pub cavities: usize,
    /// Dropped because two of their corners are the same vertex.
    pub degenerate_dropped: usize,
    /// Kept though their area is zero, because the surface would be open without them.
    pub needles_kept: usize,
    /// Dropped because the same three corners occur more than once.
    pub duplicates_dropped: usize,
    /// Turned so that neighbours agree on which side is outside.
    pub winding_repaired: usize,
    /// Components that were inside out and were turned.
    pub components_turned: usize,
    /// Edges that join four or another even number of triangles.
    pub non_manifold_edges: usize,
    /// Of these, edges that are not used equally in both directions.
    pub unbalanced_edges: usize,
    /// Enclosed volume in m³.
    pub volume_m3: f64,
    /// Area in m².
    pub area_m2: f64,
    /// Box around the surface in m.
    pub aabb: Aabb,
    /// Warnings for the user, one sentence each.
    pub warnings: Vec<String>,
}
