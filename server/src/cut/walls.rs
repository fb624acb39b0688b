//! Walls of wounds.

use std::collections::HashSet;

use palpate_tissue::{FaceId, Topology};

/// Faces of the surface with a cell next to them on the lattice: the walls of wounds. Wounds of a cut model that was stored
/// and read count as well.
pub(crate) fn wall_faces(topology: &Topology) -> Vec<FaceId> {
    let model = topology.model();
    let place = |cell: u32| model.lattice[model.cells[cell as usize].corners[0] as usize];
    let occupied: HashSet<[i32; 3]> = (0..topology.cell_count() as u32).map(place).collect();
    let has_other = |face: &FaceId| {
        let mut beside = place(face.cell());
        beside[face.face() / 2] += if face.face() % 2 == 1 { 1 } else { -1 };
        occupied.contains(&beside)
    };
    let faces = topology.boundary().faces.iter().copied();
    faces.filter(has_other).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_tissue::{BladePoint, CutStroke, Material, Vec3, block, cut};

    #[test]
    fn walls_are_two_per_opened_face_also_after_storing() {
        let mut topology = Topology::new(block([8, 6, 5], 4e-3, &Material::default(), 1).into());
        assert!(wall_faces(&topology).is_empty());
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.017, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.03,
        };
        let stroke = CutStroke {
            points: vec![point(-0.01), point(0.04)],
            width_m: 0.0,
        };
        let opened = cut(&mut topology, &stroke).unwrap().faces_opened;
        assert!(opened > 10);
        assert_eq!(wall_faces(&topology).len(), 2 * opened);
        let stored = Topology::new(topology.to_model().into());
        assert_eq!(wall_faces(&stored).len(), 2 * opened);
    }
}
