//! Node displacements of the views of the last second, for comparison with the server's corrections.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use palpate_protocol::ServerTime;
use palpate_tissue::{Shape, Vec3};

/// Number of views kept: one second at 250 Hz. Corrections of older views are ignored.
pub(crate) const HISTORY_VIEWS_MAX: usize = 256;

/// Nodes kept per view, 16 B each: 32 MiB in all if every view differs. Corrections of further nodes are ignored.
const NODES_MAX: usize = 8192;

/// Displacements below this are not kept, m.
const MOVED_M: f64 = 0.01e-3;

struct Past {
    s: ServerTime,
    topology_version: u32,
    /// Displaced nodes, ascending.
    nodes: Arc<[(u32, [f32; 3])]>,
}

/// Displacements of the latest views.
#[derive(Default)]
pub(crate) struct History {
    views: VecDeque<Past>,
    /// Corrected nodes and the time of correction: a later correction of an earlier view repeats the same difference.
    corrected: HashMap<u32, ServerTime>,
}

impl History {
    /// Stores a view. `changed` = false repeats the one before at no cost.
    pub(crate) fn push(&mut self, s: ServerTime, version: u32, shape: &Shape, changed: bool) {
        let same = self
            .views
            .back()
            .filter(|last| !changed && last.topology_version == version)
            .map(|last| Arc::clone(&last.nodes));
        let nodes = same.unwrap_or_else(|| moved(shape));
        if self.views.len() == HISTORY_VIEWS_MAX {
            self.views.pop_front();
            if let Some(oldest) = self.views.front().map(|v| v.s) {
                self.corrected.retain(|_, at| *at >= oldest);
            }
        }
        self.views.push_back(Past {
            s,
            topology_version: version,
            nodes,
        });
    }

    /// The nodes of the view at exactly this time, if it is kept.
    pub(crate) fn at(&self, s: ServerTime, version: u32) -> Option<Known> {
        let i = self.views.binary_search_by_key(&s, |v| v.s).ok()?;
        let view = &self.views[i];
        (view.topology_version == version).then(|| Known(Arc::clone(&view.nodes)))
    }

    /// Whether a correction of `node` at `s` is new. If so, the node counts as corrected in the newest view.
    pub(crate) fn is_news(&mut self, node: u32, s: ServerTime) -> bool {
        let Some(newest) = self.views.back().map(|v| v.s) else {
            return false;
        };
        if self.corrected.get(&node).is_some_and(|at| s <= *at) {
            return false;
        }
        self.corrected.insert(node, newest);
        true
    }

    /// Clears the history: a cut renumbers the nodes.
    pub(crate) fn clear(&mut self) {
        self.views.clear();
        self.corrected.clear();
    }
}

/// The nodes of one view.
pub(crate) struct Known(Arc<[(u32, [f32; 3])]>);

impl Known {
    /// Displacement of a node, m; `None` if it was not kept.
    pub(crate) fn displacement(&self, node: u32) -> Option<Vec3> {
        match self.0.binary_search_by_key(&node, |(n, _)| *n) {
            Ok(i) => Some(Vec3::from(self.0[i].1.map(f64::from))),
            Err(i) if i == self.0.len() && i == NODES_MAX => None,
            Err(_) => Some(Vec3::zeros()),
        }
    }
}

fn moved(shape: &Shape) -> Arc<[(u32, [f32; 3])]> {
    let mut nodes = Vec::new();
    for (node, u) in shape.displacement.iter().enumerate() {
        if u.norm_squared() > MOVED_M * MOVED_M {
            nodes.push((node as u32, [u.x as f32, u.y as f32, u.z as f32]));
            if nodes.len() == NODES_MAX {
                break;
            }
        }
    }
    nodes.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(nodes: usize, moved: u32) -> Shape {
        let mut displacement = vec![Vec3::zeros(); nodes];
        displacement[moved as usize] = Vec3::new(1e-3, 0.0, 0.0);
        Shape { displacement }
    }

    fn at(us: i64) -> ServerTime {
        ServerTime::from_micros(us)
    }

    #[test]
    fn history_returns_nodes_of_matching_topology_only() {
        let mut history = History::default();
        history.push(at(0), 0, &shape(10, 3), true);
        history.push(at(4000), 0, &shape(10, 4), true);
        history.push(at(8000), 0, &shape(10, 5), false);
        let then = history.at(at(0), 0).unwrap();
        assert!((then.displacement(3).unwrap().x - 1e-3).abs() < 1e-9);
        assert_eq!(then.displacement(4), Some(Vec3::zeros()));
        assert!(history.at(at(8000), 0).unwrap().displacement(4).unwrap().x > 0.0);
        assert!(history.at(at(0), 1).is_none() && history.at(at(1), 0).is_none());
    }

    #[test]
    fn node_is_corrected_once_per_view() {
        let mut history = History::default();
        for i in 0..10 {
            history.push(at(i * 4000), 0, &shape(10, 3), false);
        }
        assert!(history.is_news(3, at(0)));
        assert!(!history.is_news(3, at(4000)) && !history.is_news(3, at(36_000)));
        history.push(at(40_000), 0, &shape(10, 3), false);
        assert!(history.is_news(3, at(40_000)));
    }

    #[test]
    fn history_is_bounded() {
        let mut history = History::default();
        for i in 0..1000 {
            history.push(at(i * 4000), 0, &shape(4, 0), i == 0);
            assert!(history.is_news((i % 1000) as u32, at(i * 4000)));
        }
        assert_eq!(history.views.len(), HISTORY_VIEWS_MAX);
        assert!(history.corrected.len() <= HISTORY_VIEWS_MAX);
    }
}
