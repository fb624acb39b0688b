//! Built-in samples: closed, outward, nested, and the same bits every time.

#![allow(clippy::unwrap_used)]

use palpate_anatomy::sample::Sample;
use palpate_anatomy::{Scene, SceneInput, Surface, build};
use palpate_tissue::Vec3;

/// Winding number of a closed surface about a point.
fn winding(surface: &Surface, point: &Vec3) -> f64 {
    let half_angles: f64 = (0..surface.triangles.len())
        .map(|t| {
            let [a, b, c] = surface.corners(t).map(|p| p - point);
            let [la, lb, lc] = [a.norm(), b.norm(), c.norm()];
            let down = la * lb * lc + a.dot(&b) * lc + b.dot(&c) * la + c.dot(&a) * lb;
            a.dot(&b.cross(&c)).atan2(down)
        })
        .sum();
    half_angles / (2.0 * std::f64::consts::PI)
}

#[test]
fn samples_are_closed_outward_and_need_no_repair() {
    for sample in Sample::ALL {
        let files = sample.generate();
        for (file, surface) in &files.surfaces {
            let mut checked = surface.clone();
            let report = checked.check().unwrap_or_else(|e| panic!("{file}: {e}"));
            assert_eq!(report.warnings, Vec::<String>::new(), "{file}");
            assert_eq!(report.components, 1, "{file}");
            assert_eq!(&checked, surface, "{file}: nothing was repaired");
        }
        assert_eq!(sample.input().unwrap().warnings, Vec::<String>::new());
    }
}

#[test]
fn inner_surfaces_stay_inside_the_outermost() {
    for sample in Sample::ALL {
        let files = sample.generate();
        let (_, outer) = &files.surfaces[0];
        // Vertices in the plane sides of a block are shared with the outermost surface; moved towards the
        // middle by a thousandth they must be inside.
        let centre = outer.aabb().unwrap().centre();
        for (file, inner) in &files.surfaces[1..] {
            for p in inner.vertices.iter().step_by(37) {
                let p = centre + (p - centre) * 0.999;
                assert!((winding(outer, &p) - 1.0).abs() < 1e-6, "{file} at {p:?}");
            }
        }
    }
}

#[test]
fn marrow_lies_inside_the_femur() {
    let files = Sample::Thigh.generate();
    let find = |name: &str| {
        &files
            .surfaces
            .iter()
            .find(|(f, _)| f.contains(name))
            .unwrap()
            .1
    };
    for p in find("marrow").vertices.iter().step_by(7) {
        assert!((winding(find("femur"), p) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn samples_have_anatomical_sizes() {
    for sample in Sample::ALL {
        let files = sample.generate();
        let nodes = files.surfaces[0].1.volume() / files.scene.spacing_m.powi(3);
        let range = match sample {
            Sample::Thigh => 40_000.0..60_000.0,
            Sample::AbdominalWall | Sample::Leg => 15_000.0..40_000.0,
            Sample::Handle => 8_000.0..20_000.0,
        };
        eprintln!("{sample}: about {nodes:.0} nodes");
        assert!(range.contains(&nodes), "{sample}: {nodes}");
        for (file, surface) in &files.surfaces {
            eprintln!(
                "  {file}: {} triangles, {:.1} cm3, {:.1} mm",
                surface.triangles.len(),
                surface.volume() * 1e6,
                surface.aabb().unwrap().extent() * 1e3
            );
        }
    }
}

#[test]
fn samples_build_without_warnings() {
    for sample in Sample::ALL {
        let (model, report) = build(&sample.input().unwrap(), &mut |_, _| {}).unwrap();
        assert_eq!(report.warnings, Vec::<String>::new(), "{sample}");
        assert!(
            report.outer_surface.closed && report.outer_surface.components == 1,
            "{sample}"
        );
        assert_eq!(report.quality.inverted_cells, 0, "{sample}");
        for region in &report.regions {
            let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
            assert!(error.abs() < 0.02, "{sample}, {}: {error}", region.name);
        }
        if sample == Sample::Thigh {
            assert!(
                (40_000..60_000).contains(&model.nodes.len()),
                "{}",
                model.nodes.len()
            );
        }
    }
}

#[test]
fn written_sample_reads_back_as_the_same_scene() {
    let dir = tempfile::tempdir().unwrap();
    for sample in Sample::ALL {
        let files = sample.generate();
        let path = files.write(dir.path(), false).unwrap();
        let scene = Scene::load(&path).unwrap();
        assert_eq!(scene.to_toml(), files.scene.to_toml());
        let input = SceneInput::load(&path).unwrap();
        assert_eq!(input.warnings, Vec::<String>::new());
        for (read, (file, made)) in input.surfaces.iter().zip(&files.surfaces) {
            assert_eq!(read.triangles.len(), made.triangles.len(), "{file}");
            // A file holds f32.
            assert!((read.volume() / made.volume() - 1.0).abs() < 1e-5, "{file}");
        }
    }
}

#[test]
fn sample_does_not_overwrite_by_default() {
    let dir = tempfile::tempdir().unwrap();
    let files = Sample::Handle.generate();
    std::fs::write(dir.path().join("handle_core.stl"), "mine").unwrap();
    let refused = files.write(dir.path(), false).unwrap_err().to_string();
    assert!(
        refused.contains("handle_core.stl exists already"),
        "{refused}"
    );
    assert!(
        !dir.path().join("handle.toml").exists(),
        "nothing was written"
    );
    files.write(dir.path(), true).unwrap();
    SceneInput::load(&dir.path().join("handle.toml")).unwrap();
}

#[test]
fn unknown_sample_error_names_the_nearest_and_all() {
    let error = "tigh".parse::<Sample>().unwrap_err().to_string();
    assert!(
        error.contains("\"thigh\"?") && error.contains("abdominal-wall"),
        "{error}"
    );
    for sample in Sample::ALL {
        assert_eq!(sample.name().parse::<Sample>().unwrap(), sample);
    }
}

#[test]
fn sample_generation_is_bit_reproducible() {
    for sample in Sample::ALL {
        assert_eq!(sample.generate(), sample.generate());
    }
}
