//! Four ways to change the topology along a swept surface (Lin 2007, fig 2.3).
//!
//! Only the caption of the figure survives. The baselines are written from the methods that it names: removal of the
//! elements that the blade touches; subdivision of crossed tetrahedra, by bisecting each crossed edge, which gives the 1 + 3
//! tetrahedra of three crossed edges and the 3 + 3 of four (Bielser, Maiwald and Gross 1999; Mor and Kanade 2000); and
//! the same after moving near nodes onto the surface.

use std::collections::BTreeSet;
use std::time::Instant;

use palpate_tissue::cell::{FACES, NO_CELL};
use palpate_tissue::{CutStroke, Topology, Vec3, cut};

use super::sweep::Sweep;
use super::tetrahedra::{Tetrahedra, of_cell, volume};

/// Part of an edge within which a crossing attracts the end of the edge.
const SNAP_PART: f64 = 0.25;
/// A move may not shrink a tetrahedron below this part of its volume.
const SHRINK_MAX: f64 = 0.1;

/// A mesh after a cut.
pub(super) struct Parted {
    /// Corners of the walls on one side of the wound, wound alike.
    pub(super) walls: Vec<[Vec3; 3]>,
    /// Tetrahedra of the elements with a corner on the wound.
    pub(super) near: Vec<[Vec3; 4]>,
    /// Elements with a face on the wound.
    pub(super) along: usize,
    /// Change of the number of elements.
    pub(super) new: i64,
    pub(super) lost_m3: f64,
    pub(super) time_ms: f64,
}

/// The tetrahedra with a crossed edge, before any cut.
pub(super) fn crossed_cells(mesh: &Tetrahedra, sweep: &Sweep) -> Vec<[Vec3; 4]> {
    let mut cells: Vec<u32> = crossings(mesh, sweep)
        .into_iter()
        .flat_map(|(edge, _)| mesh.around(edge[0]).iter().map(move |&c| (c, edge)))
        .filter(|(c, edge)| mesh.cells[*c as usize].contains(&edge[1]))
        .map(|(c, _)| c)
        .collect();
    cells.sort_unstable();
    cells.dedup();
    cells.into_iter().map(|c| mesh.corners(c)).collect()
}

/// The edges that the surface crosses, and where.
fn crossings(mesh: &Tetrahedra, sweep: &Sweep) -> Vec<([u32; 2], f64)> {
    let cells = 0..mesh.cells.len() as u32;
    let near = cells.filter(|&c| sweep.may_meet(&mesh.corners(c)));
    let edges = mesh.edges(near).into_iter();
    edges
        .filter_map(|edge| {
            let [a, b] = edge.map(|n| mesh.points[n as usize]);
            sweep.crossing(&a, &b).map(|t| (edge, t))
        })
        .collect()
}

pub(super) fn removal(before: &Tetrahedra, sweep: &Sweep) -> Parted {
    let mut mesh = before.clone();
    let since = Instant::now();
    let mut removed = vec![false; mesh.cells.len()];
    for (edge, _) in crossings(&mesh, sweep) {
        for &cell in mesh.around(edge[0]) {
            removed[cell as usize] |= mesh.cells[cell as usize].contains(&edge[1]);
        }
    }
    let mut exposed: Vec<([u32; 3], Vec<u32>)> = Vec::new();
    let nodes: Vec<u32> = touched(&mesh, (0..removed.len()).filter(|&c| removed[c]));
    let mut around: Vec<u32> = nodes
        .iter()
        .flat_map(|&n| mesh.around(n))
        .copied()
        .collect();
    around.sort_unstable();
    around.dedup();
    for (wound, cells) in mesh.faces(around.iter().copied()).into_values() {
        if let [a, b] = cells[..]
            && removed[a as usize] != removed[b as usize]
        {
            // Wound outwards from the tetrahedron that stays.
            let [p, q, r] = wound;
            let (kept, face) = if removed[a as usize] {
                (b, [p, r, q])
            } else {
                (a, wound)
            };
            exposed.push((face, vec![kept]));
        }
    }
    mesh.remove(|c| removed[c as usize]);
    let time_ms = since.elapsed().as_secs_f64() * 1e3;
    let walls = exposed
        .iter()
        .filter(|(_, kept)| sweep.height(&before.centre(kept[0])) > 0.0);
    let on_wall: BTreeSet<u32> = exposed.iter().flat_map(|(face, _)| *face).collect();
    Parted {
        walls: walls
            .map(|(face, _)| face.map(|n| mesh.points[n as usize]))
            .collect(),
        near: near(&mesh, &on_wall),
        along: count_cells(exposed.iter().map(|(_, kept)| kept[0])),
        new: mesh.cells.len() as i64 - before.cells.len() as i64,
        lost_m3: before.volume() - mesh.volume(),
        time_ms,
    }
}

/// Subdivision, with or without moving near nodes onto the surface first.
pub(super) fn subdivision(before: &Tetrahedra, sweep: &Sweep, snaps: bool) -> Parted {
    let mut mesh = before.clone();
    let since = Instant::now();
    let mut on_wall = BTreeSet::new();
    let mut crossed = crossings(&mesh, sweep);
    if snaps {
        snap(&mut mesh, crossed, &mut on_wall);
        crossed = crossings(&mesh, sweep);
        crossed.retain(|(edge, _)| !edge.iter().any(|n| on_wall.contains(n)));
    }
    for (edge, t) in crossed {
        let [a, b] = edge.map(|n| mesh.points[n as usize]);
        on_wall.insert(mesh.bisect(edge, a + (b - a) * t));
    }
    let time_ms = since.elapsed().as_secs_f64() * 1e3;
    let mut around: Vec<u32> = on_wall
        .iter()
        .flat_map(|&n| mesh.around(n))
        .copied()
        .collect();
    around.sort_unstable();
    around.dedup();
    let (mut walls, mut along) = (Vec::new(), Vec::new());
    for (key, (wound, cells)) in mesh.faces(around.iter().copied()) {
        if let [a, b] = cells[..]
            && key.iter().all(|n| on_wall.contains(n))
        {
            let [first, second] = [a, b].map(|c| is_above(&mesh, c, sweep));
            if first != second {
                let [p, q, r] = wound.map(|n| mesh.points[n as usize]);
                walls.push(if first { [p, q, r] } else { [p, r, q] });
                along.extend([a, b]);
            }
        }
    }
    Parted {
        walls,
        near: near(&mesh, &on_wall),
        along: count_cells(along.into_iter()),
        new: mesh.cells.len() as i64 - before.cells.len() as i64,
        lost_m3: before.volume() - mesh.volume(),
        time_ms,
    }
}

/// Moves ends of crossed edges onto near crossings, the nearest first.
fn snap(mesh: &mut Tetrahedra, mut crossed: Vec<([u32; 2], f64)>, on_wall: &mut BTreeSet<u32>) {
    let part = |t: f64| t.min(1.0 - t);
    crossed.retain(|(_, t)| part(*t) < SNAP_PART);
    crossed.sort_by(|a, b| part(a.1).total_cmp(&part(b.1)));
    for (edge, t) in crossed {
        let node = edge[usize::from(t > 0.5)];
        if edge.iter().any(|n| on_wall.contains(n)) || !mesh.may_slide(node, edge) {
            continue;
        }
        let [a, b] = edge.map(|n| mesh.points[n as usize]);
        let sizes = |mesh: &Tetrahedra| -> Vec<f64> {
            let cells = mesh.around(node).iter();
            cells.map(|&c| volume(&mesh.corners(c))).collect()
        };
        let before = sizes(mesh);
        let from = std::mem::replace(&mut mesh.points[node as usize], a + (b - a) * t);
        let after = sizes(mesh);
        if before.iter().zip(&after).all(|(b, a)| *a > SHRINK_MAX * b) {
            on_wall.insert(node);
        } else {
            mesh.points[node as usize] = from;
        }
    }
}

/// The project's own: a sheet of faces with snapped, doubled nodes.
pub(super) fn sheet(
    before: &Topology,
    stroke: &CutStroke,
    sweep: &Sweep,
) -> Result<Parted, String> {
    let mut topology = before.clone();
    let since = Instant::now();
    let outcome = cut(&mut topology, stroke).map_err(|e| e.to_string())?;
    let time_ms = since.elapsed().as_secs_f64() * 1e3;
    let boundary = topology.boundary();
    let first = boundary.faces.len() - 2 * outcome.faces_opened;
    let place = |n: u32| topology.rest(n);
    let centre = |cell: u32| topology.corners(cell).map(place).iter().sum::<Vec3>() / 8.0;
    let (mut walls, mut nodes) = (Vec::new(), BTreeSet::new());
    for (i, face) in boundary.faces.iter().enumerate().skip(first) {
        let corners = topology.corners(face.cell());
        nodes.extend(FACES[face.face()].map(|c| corners[c]));
        if sweep.height(&centre(face.cell())) > 0.0 {
            walls.extend(
                boundary.triangles[2 * i..2 * i + 2]
                    .iter()
                    .map(|t| t.map(place)),
            );
        }
    }
    let cells = nodes.iter().flat_map(|&n| topology.cells_around(n));
    let mut cells: Vec<u32> = cells.filter(|&c| c != NO_CELL).collect();
    cells.sort_unstable();
    cells.dedup();
    let sum = |t: &Topology| (0..t.cell_count() as u32).map(|c| t.volume(c)).sum::<f64>();
    Ok(Parted {
        walls,
        near: cells
            .iter()
            .flat_map(|&c| of_cell(&topology.corners(c).map(place)))
            .collect(),
        along: count_cells(boundary.faces[first..].iter().map(|f| f.cell())),
        new: topology.cell_count() as i64 - before.cell_count() as i64,
        lost_m3: sum(before) - sum(&topology),
        time_ms,
    })
}

/// The side of the surface on which a tetrahedron is: that of its farthest corner.
fn is_above(mesh: &Tetrahedra, cell: u32, sweep: &Sweep) -> bool {
    let heights = mesh.corners(cell).map(|p| sweep.height(&p));
    let farthest = |a: f64, b: &f64| if b.abs() > a.abs() { *b } else { a };
    heights.iter().fold(0.0, farthest) > 0.0
}

fn touched(mesh: &Tetrahedra, cells: impl Iterator<Item = usize>) -> Vec<u32> {
    let mut nodes: Vec<u32> = cells.flat_map(|c| mesh.cells[c]).collect();
    nodes.sort_unstable();
    nodes.dedup();
    nodes
}

fn near(mesh: &Tetrahedra, nodes: &BTreeSet<u32>) -> Vec<[Vec3; 4]> {
    let mut cells: Vec<u32> = nodes
        .iter()
        .flat_map(|&n| mesh.around(n))
        .copied()
        .collect();
    cells.sort_unstable();
    cells.dedup();
    cells.into_iter().map(|c| mesh.corners(c)).collect()
}

fn count_cells(cells: impl Iterator<Item = u32>) -> usize {
    cells.collect::<BTreeSet<u32>>().len()
}
