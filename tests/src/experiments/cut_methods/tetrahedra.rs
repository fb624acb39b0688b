//! A mesh of tetrahedra whose edges can be bisected.

use std::collections::BTreeMap;

use palpate_tissue::{Model, Vec3};

/// The six paths along the edges of a cell from corner 0 to corner 7: its tetrahedra (Kuhn 1960). Neighbouring cells
/// halve their common face alike.
const KUHN: [[usize; 4]; 6] = [
    [0, 1, 3, 7],
    [0, 5, 1, 7],
    [0, 3, 2, 7],
    [0, 2, 6, 7],
    [0, 4, 5, 7],
    [0, 6, 4, 7],
];

/// The faces of a tetrahedron, wound outwards, each with the corner that it leaves out.
const FACES: [([usize; 3], usize); 4] = [
    ([1, 2, 3], 0),
    ([0, 3, 2], 1),
    ([0, 1, 3], 2),
    ([0, 2, 1], 3),
];

/// The corners of the tetrahedra of a cell.
pub(super) fn of_cell<T: Copy>(corners: &[T; 8]) -> [[T; 4]; 6] {
    KUHN.map(|path| path.map(|i| corners[i]))
}

/// Volume in m³; negative when it is inside out.
pub(super) fn volume([a, b, c, d]: &[Vec3; 4]) -> f64 {
    (b - a).cross(&(c - a)).dot(&(d - a)) / 6.0
}

/// Mean ratio (Liu and Joe 1994): 1 for a regular tetrahedron, 0 for a flat one, negative for one that is inside out.
pub(super) fn quality(corners: &[Vec3; 4]) -> f64 {
    let pairs = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
    let squares: f64 = pairs
        .map(|[i, j]| (corners[i] - corners[j]).norm_squared())
        .iter()
        .sum();
    let v = volume(corners);
    12.0 * v.signum() * (3.0 * v.abs()).powf(2.0 / 3.0) / squares
}

/// Tetrahedra with the tissue of each.
#[derive(Clone)]
pub(super) struct Tetrahedra {
    pub(super) points: Vec<Vec3>,
    pub(super) cells: Vec<[u32; 4]>,
    regions: Vec<u16>,
    /// The tetrahedra around each point.
    around: Vec<Vec<u32>>,
}

impl Tetrahedra {
    /// The cells of a model, six tetrahedra each.
    pub(super) fn of(model: &Model) -> Self {
        let mut mesh = Self {
            points: model.nodes.clone(),
            cells: Vec::with_capacity(6 * model.cells.len()),
            regions: Vec::new(),
            around: vec![Vec::new(); model.nodes.len()],
        };
        for cell in &model.cells {
            for corners in of_cell(&cell.corners) {
                for node in corners {
                    mesh.around[node as usize].push(mesh.cells.len() as u32);
                }
                mesh.cells.push(corners);
                mesh.regions.push(cell.region.0);
            }
        }
        mesh
    }

    pub(super) fn corners(&self, cell: u32) -> [Vec3; 4] {
        self.cells[cell as usize].map(|n| self.points[n as usize])
    }

    pub(super) fn centre(&self, cell: u32) -> Vec3 {
        self.corners(cell).iter().sum::<Vec3>() / 4.0
    }

    pub(super) fn volume(&self) -> f64 {
        (0..self.cells.len() as u32)
            .map(|c| volume(&self.corners(c)))
            .sum()
    }

    pub(super) fn around(&self, node: u32) -> &[u32] {
        &self.around[node as usize]
    }

    /// The tetrahedra around an edge.
    fn around_edge(&self, [a, b]: [u32; 2]) -> Vec<u32> {
        let cells = self.around[a as usize].iter().copied();
        cells
            .filter(|&c| self.cells[c as usize].contains(&b))
            .collect()
    }

    /// The edges of some tetrahedra, each with its lower end first.
    pub(super) fn edges(&self, cells: impl Iterator<Item = u32>) -> Vec<[u32; 2]> {
        let pairs = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
        let of_cell = |cell: u32| {
            let t = self.cells[cell as usize];
            pairs.map(|[i, j]| [t[i].min(t[j]), t[i].max(t[j])])
        };
        let mut edges: Vec<[u32; 2]> = cells.flat_map(of_cell).collect();
        edges.sort_unstable();
        edges.dedup();
        edges
    }

    /// The faces of some tetrahedra by their sorted corners: each with its tetrahedra and its corners as the first of these
    /// winds them outwards.
    pub(super) fn faces(
        &self,
        cells: impl Iterator<Item = u32>,
    ) -> BTreeMap<[u32; 3], ([u32; 3], Vec<u32>)> {
        let mut faces = BTreeMap::<[u32; 3], ([u32; 3], Vec<u32>)>::new();
        for cell in cells {
            let corners = self.cells[cell as usize];
            for (face, _) in FACES {
                let wound = face.map(|i| corners[i]);
                let mut key = wound;
                key.sort_unstable();
                let entry = faces.entry(key).or_insert((wound, Vec::new()));
                entry.1.push(cell);
            }
        }
        faces
    }

    /// Bisects an edge at a point: every tetrahedron around it becomes two. Returns the new point.
    pub(super) fn bisect(&mut self, [a, b]: [u32; 2], at: Vec3) -> u32 {
        let new = self.points.len() as u32;
        let cells = self.around_edge([a, b]);
        self.points.push(at);
        let mut around_new = Vec::with_capacity(2 * cells.len());
        for cell in cells {
            let added = self.cells.len() as u32;
            let corners = self.cells[cell as usize];
            self.cells[cell as usize] = corners.map(|n| if n == b { new } else { n });
            self.cells
                .push(corners.map(|n| if n == a { new } else { n }));
            self.regions.push(self.regions[cell as usize]);
            self.around[b as usize].retain(|&c| c != cell);
            for node in corners.into_iter().filter(|&n| n != a) {
                self.around[node as usize].push(added);
            }
            around_new.extend([cell, added]);
        }
        self.around.push(around_new);
        new
    }

    /// Whether a point may slide along an edge without a change of the outer surface or of an interface.
    pub(super) fn may_slide(&self, node: u32, edge: [u32; 2]) -> bool {
        let along = self.around_edge(edge);
        let holds = |region: &u16| along.iter().any(|&c| self.regions[c as usize] == *region);
        let around = self.around(node);
        let regions_hold = around.iter().all(|&c| holds(&self.regions[c as usize]));
        let is_outer = |cells: &[u32], with: &dyn Fn(&[u32; 3]) -> bool| {
            self.faces(cells.iter().copied())
                .iter()
                .any(|(key, (_, cells))| cells.len() == 1 && with(key))
        };
        let on_surface = is_outer(around, &|key| key.contains(&node));
        let edge_on_surface = || is_outer(&along, &|key| edge.iter().all(|n| key.contains(n)));
        regions_hold && (!on_surface || edge_on_surface())
    }

    /// Removes tetrahedra.
    pub(super) fn remove(&mut self, mut is_removed: impl FnMut(u32) -> bool) {
        let kept: Vec<u32> = (0..self.cells.len() as u32)
            .filter(|&c| !is_removed(c))
            .collect();
        self.cells = kept.iter().map(|&c| self.cells[c as usize]).collect();
        self.regions = kept.iter().map(|&c| self.regions[c as usize]).collect();
        self.around = vec![Vec::new(); self.points.len()];
        for (cell, corners) in self.cells.iter().enumerate() {
            for &node in corners {
                self.around[node as usize].push(cell as u32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_tissue::{Material, block};

    use super::*;

    fn mesh() -> Tetrahedra {
        Tetrahedra::of(&block([3, 3, 3], 1e-3, &Material::default(), 0))
    }

    fn is_conforming(mesh: &Tetrahedra) -> bool {
        let all = mesh.faces(0..mesh.cells.len() as u32);
        let outer = all.values().filter(|f| f.1.len() == 1);
        let area: f64 = outer
            .map(|(face, _)| {
                let [a, b, c] = face.map(|n| mesh.points[n as usize]);
                (b - a).cross(&(c - a)).norm() / 2.0
            })
            .sum();
        all.values().all(|f| f.1.len() <= 2) && (area - 6.0 * 9e-6).abs() < 1e-12
    }

    #[test]
    fn cells_become_equal_tetrahedra_that_conform() {
        let mesh = mesh();
        assert_eq!(mesh.cells.len(), 6 * 27);
        for cell in 0..mesh.cells.len() as u32 {
            assert!((volume(&mesh.corners(cell)) - 1e-9 / 6.0).abs() < 1e-20);
        }
        assert!(is_conforming(&mesh));
    }

    #[test]
    fn bisection_keeps_volume_and_conformity() {
        let mut mesh = mesh();
        for edge in mesh.edges(0..162).into_iter().step_by(5) {
            let [a, b] = edge.map(|n| mesh.points[n as usize]);
            mesh.bisect(edge, a + (b - a) * 0.3);
        }
        assert!((mesh.volume() - 27e-9).abs() < 1e-18);
        assert!((0..mesh.cells.len() as u32).all(|c| quality(&mesh.corners(c)) > 0.0));
        assert!(is_conforming(&mesh));
    }

    #[test]
    fn regular_tetrahedron_has_quality_one() {
        let s = 0.5_f64.sqrt();
        let corners = [
            [1.0, 0.0, -s],
            [-1.0, 0.0, -s],
            [0.0, 1.0, s],
            [0.0, -1.0, s],
        ];
        let [a, b, c, d] = corners.map(Vec3::from);
        assert!((quality(&[a, b, c, d]).abs() - 1.0).abs() < 1e-12);
        assert!(quality(&[a, b, c, d]) * quality(&[b, a, c, d]) < 0.0);
    }
}
