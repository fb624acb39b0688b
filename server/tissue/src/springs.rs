//! Springs assembled per cell from Young's modulus.
//!
//! For the cubic lattice with edge springs k1 and both diagonals of every face k2, isotropy needs
//! k1 = k2 = k, and then E = 2.5 k/Δd, Poisson's ratio is 1/4 and the shear modulus 0.4 E: so
//! k = 0.4 E Δd. A cell gives k1/4 to each of its 12 edges (four cells share an edge) and k2/2 to
//! each of its 12 face diagonals (two cells share a face). Written with the cell's own volume V and
//! the spring's own length l that is
//!
//! ```text
//! edge      0.1 E V / l²        (cube: V = Δd³, l = Δd      ->  k/4)
//! diagonal  0.4 E V / l²        (cube: V = Δd³, l = √2 Δd   ->  k/2)
//! ```
//!
//! which keeps the energy per volume of a uniform strain when a cell is scaled. Heterogeneity,
//! boundaries and the halves on both sides of a cut then come by themselves.

/// One spring as seen from one of its ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spring {
    /// Node at the other end.
    pub to: u32,
    /// Stiffness k in N/m.
    pub stiffness: f32,
    /// Rest length l0 in m.
    pub rest_length: f32,
}

/// Most springs one node can have: each of its eight cells brings three edges and three diagonals,
/// and across a cut no two of them need share their far end.
pub const SPRINGS_PER_NODE_MAX: usize = 48;

/// Share of Young's modulus that an edge spring carries; see the file's head.
pub(crate) const EDGE_SHARE: f64 = 0.1;
/// Share of Young's modulus that a face diagonal carries; see the file's head.
pub(crate) const DIAGONAL_SHARE: f64 = 0.4;
/// A spring shorter than this part of the spacing counts as this long when its stiffness is
/// computed, so that one bad corner can not make the whole system stiff.
pub(crate) const LENGTH_FLOOR: f64 = 0.25;

/// All springs, as one row per node; each spring stands in the rows of both its ends.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Springs {
    rows: Vec<Row>,
    entries: Vec<Spring>,
    /// Entries that no row points to any more, after rows were replaced.
    garbage: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Row {
    start: u32,
    len: u16,
    room: u16,
}

impl Springs {
    /// No springs for no nodes, with room for `nodes` rows.
    pub(crate) fn with_capacity(nodes: usize) -> Self {
        Self {
            rows: Vec::with_capacity(nodes),
            entries: Vec::with_capacity(nodes * 18),
            garbage: 0,
        }
    }

    /// The springs of one node, in a fixed order that depends on the topology alone.
    pub fn row(&self, node: u32) -> &[Spring] {
        let row = self.rows[node as usize];
        &self.entries[row.start as usize..row.start as usize + row.len as usize]
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Number of springs, each counted once.
    pub fn count(&self) -> usize {
        self.rows.iter().map(|r| r.len as usize).sum::<usize>() / 2
    }

    /// Puts a row in place of a node's old one, or appends the row of the next node.
    pub(crate) fn set_row(&mut self, node: u32, springs: &[Spring]) {
        let index = node as usize;
        assert!(index <= self.rows.len(), "rows are added in order");
        if let Some(row) = self.rows.get_mut(index) {
            if springs.len() <= row.room as usize {
                let start = row.start as usize;
                self.entries[start..start + springs.len()].copy_from_slice(springs);
                row.len = springs.len() as u16;
                return;
            }
            self.garbage += row.room as usize;
        }
        let row = Row {
            start: self.entries.len() as u32,
            len: springs.len() as u16,
            room: springs.len() as u16,
        };
        self.entries.extend_from_slice(springs);
        if index == self.rows.len() {
            self.rows.push(row);
        } else {
            self.rows[index] = row;
        }
        if self.garbage > self.entries.len() / 2 {
            self.compact();
        }
    }

    fn compact(&mut self) {
        let mut entries = Vec::with_capacity(self.entries.len() - self.garbage);
        for row in &mut self.rows {
            let start = entries.len() as u32;
            let old = row.start as usize;
            entries.extend_from_slice(&self.entries[old..old + row.len as usize]);
            *row = Row {
                start,
                len: row.len,
                room: row.len,
            };
        }
        self.entries = entries;
        self.garbage = 0;
    }
}
