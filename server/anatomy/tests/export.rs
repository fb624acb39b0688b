//! Exports for other programs: closed surfaces with consistent volumes, files that are complete or absent.

#![allow(clippy::unwrap_used)]

#[path = "../../tissue/tests/cut_laws/mod.rs"]
mod cut_laws;

use std::collections::BTreeMap;
use std::io::{Error, ErrorKind, Write};
use std::sync::Arc;

use cut_laws::stroke;
use palpate_anatomy::export::{stage_stl, stage_vtu, surfaces, write_vtu};
use palpate_anatomy::sample::Sample;
use palpate_anatomy::{Surface, Unit, build};
use palpate_tissue::cell::NO_CELL;
use palpate_tissue::file::Staged;
use palpate_tissue::{Material, Shape, Topology, Vec3, block, cut};

fn blocks() -> Topology {
    Topology::new(Arc::new(block([6, 5, 4], 0.004, &Material::default(), 2)))
}

/// Whether each edge is used equally often in both directions.
fn is_closed(surface: &Surface) -> bool {
    let mut uses: BTreeMap<[u32; 2], i32> = BTreeMap::new();
    for t in &surface.triangles {
        for [a, b] in [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]] {
            *uses.entry([a.min(b), a.max(b)]).or_default() += if a < b { 1 } else { -1 };
        }
    }
    uses.values().all(|&u| u == 0)
}

fn volumes(topology: &Topology, shape: &Shape) -> BTreeMap<String, f64> {
    surfaces(topology, shape)
        .into_iter()
        .filter(|s| !s.name.starts_with("interface-"))
        .map(|s| {
            assert!(is_closed(&s.surface), "{}", s.name);
            (s.name, s.surface.volume())
        })
        .collect()
}

#[test]
fn region_surfaces_are_closed_and_volumes_add_up() {
    let input = Sample::Handle.input().unwrap();
    let topology = Topology::new(Arc::new(build(&input, &mut |_, _| ()).unwrap().0));
    for topology in [topology, blocks()] {
        let volumes = volumes(&topology, &Shape::rest(&topology));
        let outer = volumes["outer"];
        let regions: f64 = volumes.values().sum::<f64>() - outer;
        assert!((regions / outer - 1.0).abs() < 1e-12, "{volumes:?}");
    }
}

#[test]
fn exported_surfaces_follow_the_shape() {
    let topology = blocks();
    let mut shape = Shape::rest(&topology);
    let before = volumes(&topology, &shape);
    for node in 0..topology.node_count() {
        shape.displacement[node] = topology.rest(node as u32) * 0.25 + Vec3::repeat(0.1);
    }
    for (name, now) in volumes(&topology, &shape) {
        assert!(
            (now / before[&name] - 1.25_f64.powi(3)).abs() < 1e-12,
            "{name}"
        );
    }
}

#[test]
fn open_wound_is_part_of_a_closed_surface() {
    let mut topology = cut_laws::topology([8, 8, 8], 0.005);
    let whole = volumes(&topology, &Shape::rest(&topology));
    let tips = [-0.005, 0.045].map(|y| Vec3::new(0.02, y, 0.02));
    let outcome = cut(&mut topology, &stroke(&tips, Vec3::z(), 0.02)).unwrap();
    assert!(!outcome.doubled.is_empty());
    let mut shape = Shape::rest(&topology);
    assert_eq!(
        volumes(&topology, &shape).keys().collect::<Vec<_>>(),
        whole.keys().collect::<Vec<_>>()
    );
    for node in 0..topology.node_count() as u32 {
        // Nodes beyond the cut and above its end move away from it.
        let cells = topology
            .cells_around(node)
            .into_iter()
            .filter(|&c| c != NO_CELL);
        let beyond = cells
            .map(|c| topology.rest(topology.corners(c)[0]).x)
            .any(|x| x > 0.0199);
        let height = (topology.rest(node).z - 0.02).max(0.0);
        if beyond {
            shape.displacement[node as usize].x = 0.3 * height;
        }
    }
    let open = volumes(&topology, &shape);
    assert!(
        (open["outer"] / whole["outer"] - 1.0).abs() < 0.01,
        "{open:?} {whole:?}"
    );
    let mut grid = Vec::new();
    write_vtu(&topology, &shape, &mut grid).unwrap();
    let head = String::from_utf8_lossy(&grid[..4000]).into_owned();
    let points = format!("NumberOfPoints=\"{}\"", topology.node_count());
    assert!(head.contains(&points), "{head}");
}

#[test]
fn interface_is_wound_outwards_from_the_later_region() {
    let topology = blocks();
    let surfaces = surfaces(&topology, &Shape::rest(&topology));
    let sheet = surfaces.iter().find(|s| s.name == "interface-base-body");
    let sheet = &sheet.unwrap().surface;
    assert_eq!(sheet.triangles.len(), 6 * 5 * 2);
    for t in 0..sheet.triangles.len() {
        let [a, b, c] = sheet.corners(t);
        assert!(
            (b - a).cross(&(c - a)).z < 0.0,
            "out of the body, which is above"
        );
    }
}

#[test]
fn stl_round_trip_leaves_no_temporary_file() {
    let topology = blocks();
    let rest = Shape::rest(&topology);
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("new");
    let staged = stage_stl(&topology, &rest, &folder).unwrap();
    drop(stage_vtu(&topology, &rest, &folder.join("m.vtu")).unwrap());
    for file in staged {
        file.put_in_place().unwrap();
    }
    let all = surfaces(&topology, &rest);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), all.len());
    for s in all.iter().filter(|s| !s.name.starts_with("interface-")) {
        let path = folder.join(format!("{}.stl", s.name));
        let back = Surface::read(&path, Unit::Millimetre).unwrap();
        assert!((back.volume() / s.surface.volume() - 1.0).abs() < 1e-6);
        assert_eq!(back.triangles.len(), s.surface.triangles.len());
    }
}

#[test]
fn same_state_gives_same_grid() {
    let topology = blocks();
    let grid = || {
        let mut out = Vec::new();
        write_vtu(&topology, &Shape::rest(&topology), &mut out).unwrap();
        out
    };
    assert_eq!(grid(), grid());
    assert!(grid().starts_with(b"<?xml"));
}

#[test]
fn failed_write_keeps_the_old_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.vtu");
    std::fs::write(&path, "old").unwrap();
    let full = Staged::write(&path, |out| {
        out.write_all(b"half of it")?;
        Err(Error::from(ErrorKind::StorageFull))
    });
    let said = full.unwrap_err().to_string();
    assert!(
        said.contains("m.vtu") && said.contains("free disk space"),
        "{said}"
    );
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "old");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    Staged::write(&path, |out| out.write_all(b"new"))
        .unwrap()
        .put_in_place()
        .unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "new");
}
