//! Builds a model and prints the result: `cargo run --release -p palpate-tissue --example build --
//! SET|SCENE.toml|ball:TRIANGLES [spacing_mm]`. A set is one of [`SETS`], read from the folder in
//! `PALPATE_DATA`; a ball of 50 mm has the given number of triangles. The output is the time of each stage, the
//! report, the shape of the finished cells, and the peak resident memory.

#![allow(clippy::print_stdout)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use palpate_anatomy::{BuildReport, Scene, SceneInput, Surface, build};
use palpate_tissue::cell::cell_volume;
use palpate_tissue::{Model, Vec3};

/// Name, folder, and (file, material) of each region in order; the last one is pinned.
type Set = (
    &'static str,
    &'static str,
    &'static [(&'static str, &'static str)],
);

/// The sets of real anatomy and of a tool.
const SETS: [Set; 10] = [
    (
        "thigh",
        "leg_bp3d",
        &[
            ("thigh_skin", "fat"),
            ("thigh_muscle", "muscle"),
            ("thigh_femur", "bone"),
        ],
    ),
    (
        "shank",
        "leg_bp3d",
        &[
            ("shank_skin", "fat"),
            ("shank_muscle", "muscle"),
            ("shank_fibula", "bone"),
            ("shank_tibia", "bone"),
        ],
    ),
    (
        "leg",
        "leg_bp3d",
        &[
            ("full_skin", "fat"),
            ("full_muscle", "muscle"),
            ("full_patella", "bone"),
            ("full_fibula", "bone"),
            ("full_tibia", "bone"),
            ("full_femur", "bone"),
        ],
    ),
    (
        "torso",
        "abdomen_ct",
        &[
            ("torso_skin_outer", "fat"),
            ("torso_subcutaneous_inner_wall_envelope", "muscle"),
            ("torso_bone", "bone"),
        ],
    ),
    (
        "slab",
        "abdomen_ct",
        &[
            ("torso_skin_outer", "fat"),
            ("slab_liver", "muscle"),
            ("slab_spleen", "muscle"),
            ("slab_kidneys", "muscle"),
            ("slab_vessels", "muscle"),
        ],
    ),
    ("handle", "tool_otoscope", &[("handle", "bone")]),
    ("head", "tool_otoscope", &[("head", "bone")]),
    ("specula", "tool_otoscope", &[("specula", "bone")]),
    ("lens", "tool_otoscope", &[("lens_large", "bone")]),
    ("battery", "tool_otoscope", &[("battery_holder", "bone")]),
];

/// Number of thin parts to print, unless `PARTS` overrides it.
const PARTS_SHOWN: usize = 12;

fn shown() -> usize {
    let asked = std::env::var("PARTS").ok();
    asked.and_then(|n| n.parse().ok()).unwrap_or(PARTS_SHOWN)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let what = arguments.next().expect("a set or a scene file");
    let spacing = arguments.next().unwrap_or_else(|| "4".to_owned());
    let begun = Instant::now();
    let input = if Path::new(&what).extension().is_some_and(|e| e == "toml") {
        SceneInput::load(Path::new(&what))
    } else if let Some(triangles) = what.strip_prefix("ball:") {
        let triangles: usize = triangles.parse().expect("a number of triangles");
        let text = format!(
            "format = \"palpate-scene/1\"\nspacing_mm = {spacing}\n[[region]]\nname = \"ball\"\n\
             surface = \"ball.stl\"\nmaterial = \"fat\"\n"
        );
        let scene = Scene::parse(&text, Path::new(".")).expect("the scene is right");
        SceneInput::new(scene, vec![ball(triangles)])
    } else {
        SceneInput::load(&scene_file(&what, &spacing))
    };
    let input = input.unwrap_or_else(|error| panic!("{error}"));
    println!(
        "read and checked in {:.2} s, {:.0} MB",
        begun.elapsed().as_secs_f64(),
        peak_mb()
    );
    let start = Instant::now();
    let mut last = (String::new(), Instant::now());
    let result = build(&input, &mut |stage, _| {
        if !last.0.is_empty() {
            let seconds = last.1.elapsed().as_secs_f64();
            println!("  {seconds:6.3} s  {:<32} {:.0} MB", last.0, peak_mb());
        }
        last = (stage.to_owned(), Instant::now());
    });
    let seconds = start.elapsed().as_secs_f64();
    let (model, report) = result.unwrap_or_else(|error| panic!("{error}"));
    println!(
        "{what} at {spacing} mm: {seconds:.2} s, {:.0} MB, {:.0} bytes per node",
        peak_mb(),
        peak_mb() * 1e6 / model.nodes.len() as f64
    );
    describe(&report);
    measure(&model);
}

fn describe(report: &BuildReport) {
    println!(
        "{:?}\n{:?}\n{:?}",
        report.springs, report.outer_surface, report.quality
    );
    for r in &report.regions {
        let per = 1.0 / report.spacing_mm;
        println!(
            "  {:<12.12} {:>7} nodes, volume {:+.2} %, {} of {} pieces (and {} crumbs), Dice {:.4}, {:.0} mm3 differ; in spacings: out {:.3} {:.2}, in {:.3} {:.2}, outside thin {:.3} {:.2}",
            r.name,
            r.nodes,
            100.0 * (r.volume_mm3 / r.input_volume_mm3 - 1.0),
            r.components,
            r.input_components,
            r.input_crumbs,
            r.dice,
            r.difference_mm3,
            r.surface_distance_mean_mm * per,
            r.surface_distance_max_mm * per,
            r.input_distance_mean_mm.unwrap_or_default() * per,
            r.input_distance_max_mm.unwrap_or_default() * per,
            r.distance_mean_outside_thin_mm * per,
            r.distance_max_outside_thin_mm * per,
        );
    }
    for part in report.thin.parts.iter().take(shown()) {
        println!("  {part}");
    }
    println!(
        "  and {} more",
        report.thin.parts.len().saturating_sub(shown()) + report.thin.more
    );
    for warning in &report.warnings {
        println!("  warning: {warning}");
    }
    if let Some(search) = report.spacing_search {
        println!("{search:?}");
    }
}

/// A ball of 50 mm with about so many triangles.
fn ball(triangles: usize) -> Surface {
    let rings = ((triangles as f64 / 4.0).sqrt() as usize).max(3);
    let sides = 2 * rings;
    let mut surface = Surface::default();
    let vertex = |ring: usize, side: usize| (1 + (ring - 1) * sides + side % sides) as u32;
    let last = (1 + (rings - 1) * sides) as u32;
    surface.vertices.push(-Vec3::z() * 0.025);
    for ring in 1..rings {
        let (up, out) = (std::f64::consts::PI * ring as f64 / rings as f64).sin_cos();
        for side in 0..sides {
            let angle = std::f64::consts::PI * side as f64 / rings as f64;
            let at = Vec3::new(up * angle.cos(), up * angle.sin(), -out);
            surface.vertices.push(at * 0.025);
        }
    }
    surface.vertices.push(Vec3::z() * 0.025);
    for side in 0..sides {
        surface
            .triangles
            .push([0, vertex(1, side + 1), vertex(1, side)]);
        for ring in 1..rings - 1 {
            let [a, b] = [vertex(ring, side), vertex(ring, side + 1)];
            let [c, d] = [vertex(ring + 1, side + 1), vertex(ring + 1, side)];
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        }
        let top = rings - 1;
        surface
            .triangles
            .push([vertex(top, side), vertex(top, side + 1), last]);
    }
    surface
}

fn scene_file(set: &str, spacing: &str) -> PathBuf {
    let data = std::env::var_os("PALPATE_DATA").expect("PALPATE_DATA names the folder with data");
    let (_, folder, regions) = SETS
        .iter()
        .find(|s| s.0 == set)
        .unwrap_or_else(|| panic!("{set} is no set: {:?}", SETS.map(|s| s.0)));
    let spacing_value = if spacing == "auto" {
        "\"auto\""
    } else {
        spacing
    };
    let pinned = regions[regions.len() - 1].0;
    let mut text = format!(
        "format = \"palpate-scene/1\"\nspacing_mm = {spacing_value}\npinned = [\"{pinned}\"]\n"
    );
    for (file, material) in *regions {
        let path = Path::new(&data).join(folder).join(format!("{file}.stl"));
        // A literal string needs no escapes.
        let _ = write!(
            text,
            "[[region]]\nname = \"{file}\"\nsurface = '{}'\nmaterial = \"{material}\"\n",
            path.display()
        );
    }
    let name = format!("palpate-{set}-{}.toml", std::process::id());
    let file = std::env::temp_dir().join(name);
    std::fs::write(&file, text).expect("the scene can be written");
    file
}

/// Measures the cells by the determinants at their eight corners and by all their springs.
fn measure(model: &Model) {
    let mut flat = [0_usize; 8];
    let mut worst: (f64, usize) = (f64::INFINITY, 0);
    let mut negative = 0;
    let mut shortest = f64::INFINITY;
    for index in 0..model.cells.len() {
        let corners = model.corners_of(index).map(|p| p / model.spacing_m);
        let mut least = f64::INFINITY;
        for c in 0..8 {
            let edge = |a: usize| {
                let to = corners[c ^ (1 << a)] - corners[c];
                if c >> a & 1 == 1 { -to } else { to }
            };
            least = least.min(edge(0).dot(&edge(1).cross(&edge(2))));
            for d in c + 1..8 {
                shortest = shortest.min((corners[c] - corners[d]).norm());
            }
        }
        let bounds = [0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5];
        flat[bounds.iter().filter(|b| least > **b).count()] += 1;
        if least < worst.0 {
            worst = (least, index);
        }
        negative += usize::from(cell_volume(&corners) <= 0.0);
    }
    println!(
        "cells by least corner determinant (<=0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, more): {flat:?}"
    );
    println!(
        "least {:.4} at {:?} mm; negative volumes {negative}; shortest spring {shortest:.4}",
        worst.0,
        model.corners_of(worst.1)[0] * 1e3
    );
}

/// Peak resident size so far in MB; 0 where the system does not report it.
fn peak_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<f64>().ok());
    kilobytes.unwrap_or(0.0) * 1.024e-3
}
