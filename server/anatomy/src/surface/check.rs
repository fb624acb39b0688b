//! The check every surface passes before a model is built from it. It rejects surfaces that enclose no volume,
//! makes all repairs that need no guessing, and reports them.

use std::collections::HashMap;

use palpate_tissue::Vec3;

use super::edges::{EdgeUse, Edges, Sets, Tally, in_mm, size_in_mm};
use super::orient::{self, Orientation};
use super::{Aabb, CheckReport, Surface};
use crate::InputError;

/// A surface smaller than this in m is reported as a likely wrong unit. Reason: the smallest feature felt
/// through a tool is some 5 mm; metres read as millimetres are a thousandth.
const SUSPICIOUSLY_SMALL_M: f64 = 5e-3;

/// A surface larger than this in m is reported as a likely wrong unit. Reason: no body is 5 m long; millimetres
/// read as metres are a thousand times larger.
const SUSPICIOUSLY_LARGE_M: f64 = 5.0;

/// Area of a triangle below which it counts as zero, relative to its longest edge squared.
/// Reason: coordinates come as f32, whose rounding alone moves a corner by 1e-7 of its size.
const NEEDLE: f64 = 1e-7;

/// Volume relative to area times extent below which nothing is enclosed. Reason: rounding of f32
/// coordinates leaves about 1e-8.
const NO_VOLUME: f64 = 1e-7;

impl Surface {
    /// Checks the surface and makes all repairs that need no guessing. Degenerate and duplicate triangles are
    /// dropped, winding is made consistent, inverted components are turned, and unused vertices are removed.
    ///
    /// Vertices must be welded, as after [`Surface::read`]. An error leaves the surface in an unspecified
    /// state. A second check of the same surface changes nothing.
    pub fn check(&mut self) -> Result<CheckReport, InputError> {
        self.refuse_nonsense()?;
        let before = self.triangles.len();
        let degenerate = self.drop_degenerate();
        let needles = self.needles();
        if needles.count == self.triangles.len() {
            let size = self
                .aabb()
                .map_or_else(String::new, |b| size_in_mm(&b.extent()));
            return Err(InputError::new(format_args!(
                "all {before} triangles have zero area (the surface is {size}): it encloses nothing; \
                 was it scaled to zero on some axis?"
            )));
        }
        let duplicates = self.drop_duplicates();
        if self.triangles.is_empty() {
            return Err(self.no_volume());
        }
        let edges = Edges::of(&self.triangles);
        self.refuse_open(&edges)?;
        let shared = edges.each().filter(|uses| uses.len() > 2);
        let shared = Tally::of(shared.map(|uses| self.edge_middle(uses)));
        let orientation = orient::orient(self, &edges)?;
        self.drop_unused_vertices();

        let aabb = self.aabb().ok_or_else(empty)?;
        let (volume_m3, area_m2) = (self.volume(), self.area());
        if volume_m3 <= NO_VOLUME * area_m2 * aabb.extent().max() {
            return Err(self.no_volume());
        }
        let Orientation {
            repaired,
            turned,
            nested,
            unbalanced_edges,
            ..
        } = orientation;
        let mut warnings = Vec::new();
        let mut say = |found: Tally, what: &str| {
            if let Some(first) = found.first {
                let (count, at) = (found.count, in_mm(&first));
                warnings.push(format!("{count} {what}; the first at {at}"));
            }
        };
        say(
            degenerate,
            "degenerate triangles (two corners in one place) were dropped",
        );
        say(
            needles,
            "triangles have zero area; they were kept, the surface would be open without them",
        );
        say(duplicates, "duplicate triangles were dropped");
        say(
            repaired,
            "triangles were wound against their neighbours and were turned",
        );
        say(turned, "components were inside out and were turned");
        say(
            shared,
            "edges join four or more triangles (parts touch along an edge); accepted",
        );
        say(
            unbalanced_edges,
            "of these edges are not used equally in both directions: volumes near them may be wrong",
        );
        say(
            nested,
            "components lie inside another one and face outward: they add nothing to it; if a cavity \
             was meant, turn them inside out",
        );
        warnings.extend(unit_warning(&aabb));
        Ok(CheckReport {
            components: orientation.components,
            cavities: orientation.cavities,
            degenerate_dropped: degenerate.count,
            needles_kept: needles.count,
            duplicates_dropped: duplicates.count,
            winding_repaired: repaired.count,
            components_turned: turned.count,
            non_manifold_edges: shared.count,
            unbalanced_edges: unbalanced_edges.count,
            volume_m3,
            area_m2,
            aabb,
            warnings,
        })
    }

    fn refuse_nonsense(&self) -> Result<(), InputError> {
        if self.triangles.is_empty() {
            return Err(empty());
        }
        let vertices = self.vertices.len();
        for (triangle, corners) in self.triangles.iter().enumerate() {
            if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= vertices) {
                return Err(InputError::new(format_args!(
                    "triangle {triangle} names vertex {vertex} of {vertices}; export the surface again"
                )));
            }
        }
        let is_bad = |p: &&Vec3| !p.iter().all(|x| x.is_finite());
        let count = self.vertices.iter().filter(is_bad).count();
        let Some(first) = self.vertices.iter().position(|p| is_bad(&p)) else {
            return Ok(());
        };
        Err(InputError::new(format_args!(
            "{count} vertices have a coordinate that is infinite or not a number, the first is \
             vertex {first}; export the surface again"
        )))
    }

    /// Drops triangles with two corners at the same vertex: their edges cancel, no hole opens.
    fn drop_degenerate(&mut self) -> Tally {
        let kept = |&[a, b, c]: &[u32; 3]| a != b && b != c && c != a;
        self.drop_all_but(kept)
    }

    /// Drops the triangles that `keep` rejects.
    fn drop_all_but(&mut self, mut keep: impl FnMut(&[u32; 3]) -> bool) -> Tally {
        let kept: Vec<bool> = self.triangles.iter().map(&mut keep).collect();
        let dropped = (0..kept.len()).filter(|t| !kept[*t]);
        let dropped = Tally::of(dropped.map(|t| self.middle(t)));
        let mut kept = kept.into_iter();
        self.triangles
            .retain(|_| kept.next().expect("one flag per triangle"));
        dropped
    }

    /// The triangles without area though their corners differ. Dropping one would tear the surface along
    /// its long edge, so they stay: they enclose nothing and hide nothing.
    fn needles(&self) -> Tally {
        let flat = (0..self.triangles.len()).filter(|&t| {
            let [a, b, c] = self.corners(t);
            let longest = [b - a, c - b, a - c].map(|e| e.norm_squared());
            let longest = longest.into_iter().fold(0.0, f64::max);
            (b - a).cross(&(c - a)).norm() * 0.5 <= NEEDLE * longest
        });
        Tally::of(flat.map(|t| self.middle(t)))
    }

    /// Of triangles with the same corners, equally wound ones are repetitions of one triangle, and two of
    /// opposite winding are a fold without thickness: both are dropped.
    fn drop_duplicates(&mut self) -> Tally {
        let mut balance: HashMap<[u32; 3], (u32, i64)> = HashMap::new();
        let signed = |&[a, b, c]: &[u32; 3]| {
            let mut key = [a, b, c];
            key.sort_unstable();
            let even = [[a, b, c], [b, c, a], [c, a, b]].contains(&key);
            (key, if even { 1 } else { -1 })
        };
        for t in &self.triangles {
            let (key, sign) = signed(t);
            let entry = balance.entry(key).or_default();
            entry.0 += 1;
            entry.1 += sign;
        }
        if balance.len() == self.triangles.len() {
            return Tally::default();
        }
        self.drop_all_but(|t| {
            let (key, sign) = signed(t);
            match balance.get_mut(&key) {
                Some((1, _)) => true,
                // The first one of the prevailing winding stays; after it no other is kept.
                Some((_, surplus)) if surplus.signum() == sign => {
                    *surplus = 0;
                    true
                }
                _ => false,
            }
        })
    }

    fn refuse_open(&self, edges: &Edges) -> Result<(), InputError> {
        let odd: Vec<EdgeUse> = edges
            .each()
            .filter(|uses| uses.len() % 2 == 1)
            .map(|uses| uses[0])
            .collect();
        if odd.is_empty() {
            return Ok(());
        }
        let single = edges.each().filter(|uses| uses.len() == 1).count();
        let mut sets = Sets::new(self.vertices.len());
        for e in &odd {
            sets.join(e.low, e.high);
        }
        let mut holes: HashMap<u32, Vec<Vec3>> = HashMap::new();
        for e in &odd {
            let ends = [e.low, e.high].map(|v| self.vertices[v as usize]);
            holes.entry(sets.find(e.low)).or_default().extend(ends);
        }
        // The representative breaks ties, so that the message does not change from run to run.
        let largest = holes
            .iter()
            .max_by_key(|(id, points)| (points.len(), u32::MAX - **id));
        let largest = largest.and_then(|(_, points)| {
            let b = Aabb::around(points)?;
            Some(format!(
                "{} {} edges, is {} and centred at {}",
                if holes.len() == 1 {
                    "it has"
                } else {
                    "the largest has"
                },
                points.len() / 2,
                size_in_mm(&b.extent()),
                in_mm(&b.centre())
            ))
        });
        let (loops, largest) = (holes.len(), largest.unwrap_or_default());
        let word = if loops == 1 { "hole" } else { "holes" };
        let more = match odd.len() - single {
            0 => String::new(),
            n => format!("; {n} more edges join three or another odd number of triangles"),
        };
        Err(InputError::new(format_args!(
            "the surface is open: {single} boundary edges in {loops} {word}; {largest}{more}; close \
             the {word} (\"fill holes\" or \"make manifold\" in a mesh tool) and export again"
        )))
    }

    fn drop_unused_vertices(&mut self) {
        let mut kept = vec![false; self.vertices.len()];
        for v in self.triangles.iter().flatten() {
            kept[*v as usize] = true;
        }
        if kept.iter().all(|k| *k) {
            return;
        }
        let mut next = 0;
        let renumbered: Vec<u32> = kept
            .iter()
            .map(|k| {
                let n = next;
                next += u32::from(*k);
                n
            })
            .collect();
        let mut keep = kept.iter();
        self.vertices
            .retain(|_| *keep.next().expect("one flag per vertex"));
        for v in self.triangles.iter_mut().flatten() {
            *v = renumbered[*v as usize];
        }
    }

    fn no_volume(&self) -> InputError {
        InputError::new(format_args!(
            "the surface encloses no volume ({:.3} mm³ inside {:.1} mm² of area); it is folded flat \
             or its parts cancel; export it again",
            self.volume() * 1e9,
            self.area() * 1e6
        ))
    }
}

fn empty() -> InputError {
    InputError::new("the surface is empty: it has no triangle; export it again")
}

/// Warns of a size that a wrong unit would explain.
fn unit_warning(aabb: &Aabb) -> Option<String> {
    let size = aabb.extent();
    let advice = if size.max() < SUSPICIOUSLY_SMALL_M {
        "very small; was it written in metres? Then set unit = \"m\""
    } else if size.max() > SUSPICIOUSLY_LARGE_M {
        "very large; was it written in millimetres and read as metres?"
    } else {
        return None;
    };
    Some(format!("the surface is {}: {advice}", size_in_mm(&size)))
}
