//! Cuts of blocks: snapping, a curve, crossing cuts, a piece cut off.

use palpate_server::picture::{Panel, View};
use palpate_tissue::{BladePoint, CutStroke, RegionId, Shape, Topology, Vec3};

use super::opened::{Cut, connected, nodes_of, opened, pulled};
use super::{Check, Picture};
use crate::test_model::soft_block;

/// A stroke with a blade along `axis` whose tips are `depth_m` below points of the top.
fn stroke(entries: &[Vec3], axis: Vec3, depth_m: f64, above_m: f64) -> CutStroke {
    let axis = axis.normalize();
    let point = |at: &Vec3| BladePoint {
        tip: at - axis * depth_m,
        axis,
        depth_m: depth_m + above_m,
    };
    CutStroke {
        points: entries.iter().map(point).collect(),
        width_m: 0.0,
    }
}

/// Points of a curve.
fn path(count: u32, at: impl Fn(f64) -> Vec3) -> Vec<Vec3> {
    (0..=count)
        .map(|i| at(f64::from(i) / f64::from(count)))
        .collect()
}

fn length_m(path: &[Vec3]) -> f64 {
    path.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

/// A block of muscle with a pinned base under two layers of cells of fat.
fn layered(cells: [usize; 3], spacing_m: f64) -> Topology {
    let mut model = soft_block(cells, spacing_m);
    let body = model.regions.len() - 1;
    model.regions[body].name = "muscle".into();
    model.regions[body].material.name = "muscle".into();
    let mut fat = model.regions[body].clone();
    fat.name = "fat".into();
    fat.material.name = "fat".into();
    model.regions.push(fat);
    let per_layer = cells[0] * cells[1];
    for cell in &mut model.cells[per_layer * (cells[2] - 2)..] {
        cell.region = RegionId(body as u16 + 1);
    }
    Topology::new(model.into())
}

fn distance_m(p: &Vec3, path: &[Vec3]) -> f64 {
    let distance = |w: &[Vec3]| {
        let way = w[1] - w[0];
        let share = ((p - w[0]).dot(&way) / way.norm_squared()).clamp(0.0, 1.0);
        (p - w[0] - way * share).norm()
    };
    path.windows(2).map(distance).fold(f64::INFINITY, f64::min)
}

/// Nodes of a coarse surface, before and after they are snapped onto a path.
pub(super) fn snapping() -> Result<Picture, String> {
    let (cells, spacing) = ([12, 10, 5], 5e-3);
    let top = cells[2] as f64 * spacing;
    let mut topology = layered(cells, spacing);
    let path = path(30, |s| {
        Vec3::new(
            0.0083 + 0.044 * s,
            0.0147 + 0.019 * s + 3e-3 * (6.0 * s).sin(),
            top,
        )
    });
    let all = |_: &_, _: &_| true;
    let view = View::along(2);
    let shape = Shape::rest(&topology);
    let before = Panel::surface(
        "coarse surface before the cut",
        &topology,
        &shape,
        view,
        all,
    );
    let made = Cut::make(&mut topology, &stroke(&path, Vec3::z(), 0.012, spacing))?;
    let nodes = nodes_of(&topology, opened(&topology, &made.outcome));
    let at_top = nodes.into_iter().map(|n| topology.rest(n));
    let at_top: Vec<Vec3> = at_top.filter(|p| p.z > top - 1e-6).collect();
    let off = at_top.iter().map(|p| distance_m(p, &path));
    let check = Check {
        quantity: "largest distance of the surface nodes from the path (mm)",
        measured: off.fold(0.0, f64::max) * 1e3,
        expected: 0.0,
    };
    let shape = Shape::rest(&topology);
    let after = Panel::surface("nodes snapped onto the path", &topology, &shape, view, all);
    let panels = [
        before.with_line(&path),
        after.with_line(&path).with_dots(&at_top),
    ];
    Picture::of(
        "snapping",
        "7.14",
        &topology,
        &[made],
        &panels,
        Some(&check),
    )
}

/// An arbitrary curve, seen from above and pulled apart.
pub(super) fn curve() -> Result<Picture, String> {
    let (cells, spacing) = ([30, 20, 8], 3e-3);
    let top = cells[2] as f64 * spacing;
    let depth = 0.0151;
    let mut topology = layered(cells, spacing);
    let path = path(60, |s| {
        let x = 0.0113 + 0.068 * s;
        Vec3::new(
            x,
            0.0301 + 0.011 * (2.2 * std::f64::consts::PI * s).sin(),
            top,
        )
    });
    let made = Cut::make(&mut topology, &stroke(&path, Vec3::z(), depth, spacing))?;
    let check = Check {
        quantity: "area of a wall (mm²)",
        measured: made.area_m2 * 1e6,
        expected: length_m(&path) * depth * 1e6,
    };
    let all = |_: &_, _: &_| true;
    let rest = Shape::rest(&topology);
    let above = Panel::surface("from above, at rest", &topology, &rest, View::along(2), all);
    let shape = pulled(&topology, [0.0, 0.12]);
    let view = View::from(Vec3::new(0.25, -0.9, 1.5), Vec3::z());
    let apart = Panel::surface("sides pulled out by 12 %", &topology, &shape, view, all);
    let panels = [above.with_line(&path), apart];
    Picture::of("curve", "7.15", &topology, &[made], &panels, Some(&check))
}

/// A cut in two strokes, the second of which continues the first, and a cut across them.
pub(super) fn crossing() -> Result<Picture, String> {
    let (cells, spacing) = ([24, 20, 8], 3e-3);
    let top = cells[2] as f64 * spacing;
    let depth = 0.0121;
    let mut topology = layered(cells, spacing);
    let along = |from: f64, until: f64| {
        path(30, move |s| {
            let x = from + (until - from) * s;
            Vec3::new(x, 0.0297 + 0.003 * (70.0 * x).sin(), top)
        })
    };
    let paths = [
        along(0.0112, 0.0401),
        along(0.0401, 0.0612),
        path(30, |s| {
            Vec3::new(0.0271 + 0.014 * s, 0.0118 + 0.037 * s, top)
        }),
    ];
    let (mut cuts, mut area) = (Vec::new(), 0.0);
    for path in &paths {
        let made = Cut::make(&mut topology, &stroke(path, Vec3::z(), depth, spacing))?;
        area += made.area_m2;
        cuts.push(made);
    }
    let check = Check {
        quantity: "area of a wall (mm²)",
        measured: area * 1e6,
        expected: paths.iter().map(|p| length_m(p)).sum::<f64>() * depth * 1e6,
    };
    let all = |_: &_, _: &_| true;
    let rest = Shape::rest(&topology);
    let mut above = Panel::surface("from above, at rest", &topology, &rest, View::along(2), all);
    for path in &paths {
        above = above.with_line(path);
    }
    let shape = pulled(&topology, [0.1, 0.1]);
    let view = View::from(Vec3::new(0.35, -0.8, 1.5), Vec3::z());
    let apart = Panel::surface("sides pulled out by 10 %", &topology, &shape, view, all);
    Picture::of(
        "crossing",
        "7.20",
        &topology,
        &cuts,
        &[above, apart],
        Some(&check),
    )
}

/// A wedge between two oblique cuts, lifted out.
pub(super) fn piece() -> Result<Picture, String> {
    let (cells, spacing) = ([20, 14, 10], 3e-3);
    let [width, long, top] = cells.map(|n| n as f64 * spacing);
    let (depth, slope) = (0.0165, 0.8_f64);
    let mut topology = layered(cells, spacing);
    let mut cuts = Vec::new();
    for side in [-1.0, 1.0] {
        let axis = Vec3::new(side * slope, 0.0, 1.0);
        let entry = |y: f64| Vec3::new(width / 2.0 + side * slope * depth, y, top);
        // The second blade passes through the first cut.
        let deep = (depth + spacing) * (1.0 + slope * slope).sqrt();
        let ends = [entry(-spacing), entry(long + spacing)];
        cuts.push(Cut::make(
            &mut topology,
            &stroke(&ends, axis, deep, 2.0 * spacing),
        )?);
    }
    let centre = |c: u32| {
        let corners = topology.corners(c).map(|n| topology.rest(n));
        corners.iter().sum::<Vec3>() / 8.0
    };
    let inside = Vec3::new(width / 2.0, long / 2.0, top);
    let off = |c: u32| (centre(c) - inside).norm();
    let start = (0..topology.cell_count() as u32).min_by(|a, b| off(*a).total_cmp(&off(*b)));
    let wedge = connected(&topology, start.unwrap_or(0));
    let volume: f64 = wedge.iter().map(|&c| topology.volume(c)).sum();
    let check = Check {
        quantity: "volume of the piece (mm³)",
        measured: volume * 1e9,
        expected: slope * depth * depth * long * 1e9,
    };
    let mut shape = Shape::rest(&topology);
    let nodes: std::collections::BTreeSet<u32> =
        wedge.iter().flat_map(|&c| topology.corners(c)).collect();
    for node in nodes {
        shape.displacement[node as usize] = Vec3::new(0.0, 0.0, 0.012);
    }
    let all = |_: &_, _: &_| true;
    let oblique = View::from(Vec3::new(0.35, -1.0, 0.7), Vec3::z());
    let front = Panel::surface(
        "from the front, at rest",
        &topology,
        &Shape::rest(&topology),
        View::along(1),
        all,
    );
    let lifted = Panel::surface("piece lifted by 12 mm", &topology, &shape, oblique, all);
    let plane = |side: f64| {
        let at = |h: f64| Vec3::new(width / 2.0 + side * slope * h, 0.0, top - depth + h);
        [at(0.0), at(depth)]
    };
    let front = front.with_line(&plane(-1.0)).with_line(&plane(1.0));
    Picture::of(
        "piece",
        "7.20",
        &topology,
        &cuts,
        &[front, lifted],
        Some(&check),
    )
}
