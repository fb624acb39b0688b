//! All contacts of one shape: tools, their samples, and the forces on nodes.

use super::ball::Ball;
use super::channel::Around;
use super::contact_sample::{Sample, depth, sample};
use super::line_search::{LineSearch, Row, TieRow};
use super::multipliers::{Change, Multipliers};
use super::proxy::{Placement, Proxy};
use super::surface::{Foot, Surface, blend};
use super::surface_index::{SurfaceChange, SurfaceIndex, SurfaceTree};
use super::tie::{Held, Spread};
use super::{MULTIPLIER_MAX, TOOLS_MAX, Tool};
use crate::equilibrium::{Disabled, Mechanism, STEADY, laid_out, trim};
use crate::{Topology, Vec3};

const NONE: u32 = u32::MAX;

/// The contacts of one shape.
pub(crate) struct Contacts {
    index: SurfaceIndex,
    pub(crate) proxies: Vec<Proxy>,
    pub(crate) samples: Vec<Sample>,
    /// Points in the tissue that inserted needles hold.
    pub(super) held: Vec<Held>,
    /// Nodes of the samples and of the held points, and the position of every node in this list.
    pub(crate) nodes: Vec<u32>,
    place: Vec<u32>,
    /// Displacements of these nodes when the samples were gathered, in m.
    gathered_at: Vec<Vec3>,
    /// Whether the shape has changed since the last update of the multipliers.
    pub(crate) is_solved: bool,
    /// Whether the last update of the multipliers changed the force of a tool.
    pub(crate) is_apart: bool,
    /// Whether a needle has changed its forces at the end of the last step.
    pub(crate) is_unsettled: bool,
    /// Invalid or excess tools of the last step.
    pub(crate) ignored: usize,
    /// Mechanisms that an ablation has switched off.
    pub(crate) disabled: Disabled,
}

impl Contacts {
    pub(crate) fn new(topology: &Topology) -> Self {
        Self {
            index: SurfaceIndex::new(topology),
            proxies: Vec::with_capacity(TOOLS_MAX),
            samples: Vec::new(),
            held: Vec::new(),
            nodes: Vec::new(),
            place: laid_out(NONE, topology.node_count()),
            gathered_at: Vec::new(),
            is_solved: false,
            is_apart: false,
            is_unsettled: false,
            ignored: 0,
            disabled: Disabled::default(),
        }
    }

    /// Continues on the topology after an undo that has the levels rebuilt, maybe with fewer nodes.
    pub(crate) fn exchange(&mut self, topology: &Topology, index: &mut SurfaceIndex) {
        // Samples of the last step may refer to nodes that are gone.
        self.clear();
        // After such an undo all nodes made by cuts have other numbers.
        self.follow_nodes(topology, topology.model().nodes.len());
        self.place = laid_out(NONE, topology.node_count());
        std::mem::swap(&mut self.index, index);
    }

    /// Follows a cut or an undo that leaves the nodes below `kept` in place.
    pub(crate) fn follow(
        &mut self,
        topology: &Topology,
        kept: usize,
        change: &SurfaceChange,
        tree: Option<&mut SurfaceTree>,
    ) {
        self.follow_nodes(topology, kept);
        trim(&mut self.place, topology.node_count());
        self.place.resize(topology.node_count(), NONE);
        self.index.follow(topology, change, tree);
    }

    fn follow_nodes(&mut self, topology: &Topology, kept: usize) {
        for proxy in &mut self.proxies {
            proxy.multipliers.follow(topology, kept);
        }
    }

    /// Sets the tools of a step. Returns whether any tool changed.
    pub(crate) fn begin(&mut self, tools: &[Tool]) -> bool {
        let mut changed = std::mem::take(&mut self.is_unsettled);
        self.ignored = 0;
        self.proxies.iter_mut().for_each(|p| p.seen = false);
        for tool in tools {
            let known = self.proxies.iter().position(|p| p.id == tool.id);
            match known {
                _ if !tool.is_sound() => self.ignored += 1,
                Some(i) if self.proxies[i].seen => self.ignored += 1,
                Some(i) => {
                    let proxy = &mut self.proxies[i];
                    changed |= proxy.follow(tool);
                    proxy.seen = true;
                }
                None if self.proxies.len() < TOOLS_MAX => {
                    self.proxies.push(Proxy::new(tool));
                    changed = true;
                }
                None => self.ignored += 1,
            }
        }
        let before = self.proxies.len();
        self.proxies.retain(|p| p.seen);
        let gone = self.proxies.len() != before;
        if gone {
            // Samples refer to proxies by position.
            self.clear();
        }
        changed | gone
    }

    /// Moves the proxies and gathers the samples within their reach. Returns whether a proxy lags behind its tool.
    pub(crate) fn gather(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        displaced: f64,
        own_stiffness: &[f64],
        fixed: &[bool],
    ) -> bool {
        self.update_bounds(u);
        let at_tip: Vec<f64> = (0..self.proxies.len())
            .map(|i| self.pressed_at_tip_n(topology, u, i))
            .collect();
        self.augment(u, fixed, topology.model().spacing_m);
        self.clear();
        let spacing = topology.model().spacing_m;
        self.proxies.iter_mut().for_each(|p| p.fit(spacing));
        let balls: Vec<Ball> = self.proxies.iter().flat_map(|p| p.balls(spacing)).collect();
        self.index.watch(topology, u, displaced, &balls);
        let surface = Surface {
            topology,
            u: Some(u),
            index: &self.index,
        };
        let around = Around {
            topology,
            u,
            own: own_stiffness,
        };
        let mut lags = false;
        for (i, proxy) in self.proxies.iter_mut().enumerate() {
            proxy.follow_insertion(&surface, &around, at_tip[i]);
            proxy.advance(&surface);
            if proxy.insertion.is_in() {
                lags |= proxy.lag() > 0.0;
                proxy.hold(&around, i, &mut self.held);
            } else if proxy.touching {
                lags |= proxy.lag() > 0.0;
                sample(&mut self.samples, &surface, proxy, i, own_stiffness);
            }
        }
        self.link();
        let displacements = self.nodes.iter().map(|&node| u[node as usize]);
        self.gathered_at.extend(displacements);
        lags
    }

    /// Whether the next motion of a proxy may differ from its last one, rather than being none.
    pub(crate) fn are_proxies_following(&self) -> bool {
        self.proxies.iter().any(Proxy::is_following)
    }

    /// Largest pace of a tool in contact: how far the tissue may be expected to move on as in the last step.
    pub(crate) fn pace(&self) -> f64 {
        let in_contact = self.proxies.iter().filter(|p| p.is_in_contact());
        in_contact.map(Proxy::pace).fold(0.0, f64::max)
    }

    /// Whether a node has moved by more than `limit` m since the samples were gathered.
    pub(crate) fn have_moved(&self, u: &[Vec3], limit: f64) -> bool {
        let moves = self.nodes.iter().zip(&self.gathered_at);
        let mut lengths = moves.map(|(&node, at)| (u[node as usize] - at).norm());
        lengths.any(|length| length > limit)
    }

    /// Moves a known tool that touches nothing to its target, unless it touches something there. Returns whether it is
    /// free.
    pub(crate) fn move_free(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        displaced: f64,
        tool: &Tool,
    ) -> bool {
        let known = self.proxies.iter().position(|p| p.id == tool.id);
        let Some(i) = known.filter(|&i| !self.proxies[i].touching && tool.is_sound()) else {
            return false;
        };
        let spacing = topology.model().spacing_m;
        let mut moved = self.proxies[i].clone();
        moved.follow(tool);
        moved.fit(spacing);
        let others = self.proxies.iter().filter(|p| p.id != tool.id);
        let all = others.chain([&moved]);
        let balls: Vec<Ball> = all.flat_map(|p| p.balls(spacing)).collect();
        self.index.watch(topology, u, displaced, &balls);
        let surface = Surface {
            topology,
            u: Some(u),
            index: &self.index,
        };
        moved.go(&surface);
        let is_free = !moved.touching;
        if is_free {
            self.proxies[i] = moved;
        }
        is_free
    }

    /// Whether no tool touches the tissue, now or if every node were within `sag` m of its rest position.
    pub(crate) fn are_clear(&self, topology: &Topology, u: &[Vec3], sag: f64) -> bool {
        let pressed = |sample: &Sample| self.force_over_stiffness(sample, u).0 > 0.0;
        if self.samples.iter().any(pressed) {
            return false;
        }
        let surface = Surface {
            topology,
            u: None,
            index: &self.index,
        };
        let pitch = topology.model().spacing_m;
        let clear = |proxy: &Proxy| {
            let (points, apart) = proxy.core.points_and_pitch(pitch);
            // Between two core points the tissue may be nearer.
            let slack = if proxy.core.is_point() { 0.0 } else { apart };
            points.into_iter().all(|point| {
                let at = proxy.core.at(point);
                let outside = |foot: Foot| {
                    let away = at - foot.at;
                    away.dot(&foot.normal) > 0.0 && away.norm() > proxy.radius + sag + slack
                };
                surface.nearest(at, f64::MAX).is_none_or(outside)
            })
        };
        self.proxies
            .iter()
            .all(|p| p.placement != Placement::New && !p.insertion.is_in() && clear(p))
    }

    /// Drops all samples: the tissue is at rest, and all tools are clear of it.
    pub(crate) fn rest(&mut self) {
        self.clear();
        for proxy in &mut self.proxies {
            proxy.set_depth(None, 0.0);
            proxy.multipliers.clear();
        }
    }

    /// Updates the gap of each proxy and the bounds of its motion, so that no proxy outruns the tissue.
    fn update_bounds(&mut self, u: &[Vec3]) {
        for proxy in &mut self.proxies {
            proxy.clear_constraints();
        }
        let mut nearest = vec![f64::NEG_INFINITY; self.proxies.len()];
        for sample in &self.samples {
            let (v, radius) = self.offset(sample, u);
            let (depth, n) = depth(v, radius);
            let i = sample.proxy as usize;
            nearest[i] = nearest[i].max(depth);
            self.proxies[i].add_constraint(depth, n, &sample.position(u));
        }
        let retreats = self.disabled.allows(Mechanism::RetreatSearch);
        for (proxy, nearest) in self.proxies.iter_mut().zip(nearest) {
            if nearest.is_finite() && retreats {
                proxy.gap = (-nearest).max(0.0);
            }
        }
    }

    /// Forgets all samples, with their memory.
    pub(crate) fn forget(&mut self) {
        self.clear();
        (self.nodes, self.samples, self.held) = Default::default();
        self.gathered_at = Vec::new();
    }

    fn clear(&mut self) {
        for &node in &self.nodes {
            self.place[node as usize] = NONE;
        }
        self.nodes.clear();
        self.gathered_at.clear();
        self.samples.clear();
        self.held.clear();
    }

    fn link(&mut self) {
        let held = self.held.iter().flat_map(|held| held.spreads);
        let spreads = held.map(|spread| spread.nodes);
        for nodes in self.samples.iter().map(|s| s.nodes).chain(spreads) {
            for node in nodes {
                let place = &mut self.place[node as usize];
                if *place == NONE {
                    *place = self.nodes.len() as u32;
                    self.nodes.push(node);
                }
            }
        }
    }

    /// Force of a sample over κ in m, and its direction, into the tissue: `max(0, λ/κ + depth)`.
    #[inline]
    pub(crate) fn force_over_stiffness(&self, sample: &Sample, u: &[Vec3]) -> (f64, Vec3) {
        let (v, radius) = self.offset(sample, u);
        let radius = radius + sample.multiplier;
        // Early exit without a square root: most samples in reach do not touch.
        if v.norm_squared() >= radius * radius {
            return (0.0, Vec3::zeros());
        }
        depth(v, radius)
    }

    /// Passes the force of each sample on to the multipliers, once per shape. Fixed nodes cannot give way, so the penalty
    /// alone presses on them.
    pub(crate) fn augment(&mut self, u: &[Vec3], fixed: &[bool], spacing: f64) {
        if self.samples.is_empty() {
            self.is_apart = false;
            return;
        }
        if !std::mem::take(&mut self.is_solved) {
            return;
        }
        self.is_apart = false;
        for i in 0..self.proxies.len() {
            let (mut before, mut pressed) = (0.0, 0.0);
            let mut changes = Vec::new();
            for s in self.samples.iter().filter(|s| s.proxy == i as u32) {
                let force = self.force_over_stiffness(s, u).0;
                let by = force - s.multiplier;
                let free = (0..3).filter(|&k| !fixed[s.nodes[k] as usize]);
                changes.extend(free.map(|k| Change {
                    node: s.nodes[k],
                    weight: s.weights[k] * s.stiffness,
                    by,
                }));
                before += s.stiffness * s.multiplier;
                pressed += s.stiffness * force;
            }
            let most = MULTIPLIER_MAX * spacing;
            self.proxies[i].multipliers.add(changes, most);
            let now = self.read_multipliers(i);
            self.is_apart |= (now - before).abs() > STEADY * pressed;
        }
    }

    /// Passes the multipliers of proxy `i` on to its samples. Returns their sum in N.
    fn read_multipliers(&mut self, i: usize) -> f64 {
        let multipliers = &self.proxies[i].multipliers;
        let mut sum = 0.0;
        for s in self.samples.iter_mut().filter(|s| s.proxy == i as u32) {
            s.multiplier = multipliers.at(&s.nodes, &s.weights);
            sum += s.stiffness * s.multiplier;
        }
        sum
    }

    /// The multipliers of each proxy.
    pub(crate) fn multipliers(&self) -> Vec<Multipliers> {
        let of = |proxy: &Proxy| proxy.multipliers.clone();
        self.proxies.iter().map(of).collect()
    }

    /// Returns to the multipliers of an earlier shape.
    pub(crate) fn restore(&mut self, multipliers: Vec<Multipliers>) {
        for (i, multipliers) in multipliers.into_iter().enumerate() {
            self.proxies[i].multipliers = multipliers;
            self.read_multipliers(i);
        }
        self.is_solved = false;
    }

    /// Position of a sample relative to the core of its tool, and the tool's radius, in m.
    #[inline]
    fn offset(&self, sample: &Sample, u: &[Vec3]) -> (Vec3, f64) {
        let proxy = &self.proxies[sample.proxy as usize];
        (proxy.core.towards(&sample.position(u)), proxy.radius)
    }

    /// The samples along shapes `u + (s - at) by`.
    pub(crate) fn line_search(&self, u: &[Vec3], by: impl Fn(u32) -> Vec3, at: f64) -> LineSearch {
        let moves: Vec<Vec3> = self.nodes.iter().map(|&n| by(n)).collect();
        let row = |sample: &Sample| {
            let by = blend(&sample.nodes.map(|n| moves[self.place(n)]), &sample.weights);
            let x = sample.position(u);
            let proxy = &self.proxies[sample.proxy as usize];
            Row {
                from: x - proxy.core.mid - by * at,
                by,
                radius: proxy.radius + sample.multiplier,
                stiffness: sample.stiffness,
                tool: sample.proxy,
            }
        };
        let cores = self.proxies.iter().map(|p| p.core).collect();
        let ties = self.held.iter().flat_map(|held| {
            let by = held.sum(|n| moves[self.place(n)]);
            let from = held.position(u) - by * at;
            held.ties.map(|tie| TieRow {
                from: tie.direction.dot(&from) - tie.target,
                by: tie.direction.dot(&by),
                tie,
            })
        });
        LineSearch::new(self.samples.iter().map(row).collect(), cores).with_ties(ties.collect())
    }

    /// Calls `visit` with the nodes of every pressed sample, its force in N, its κ and its direction; likewise for ties.
    #[inline]
    pub(crate) fn pressed(&self, u: &[Vec3], mut visit: impl FnMut(&Spread, Vec3, f64, Vec3)) {
        for sample in &self.samples {
            let (pressed, n) = self.force_over_stiffness(sample, u);
            if pressed > 0.0 {
                let force = n * (sample.stiffness * pressed);
                visit(&sample.spread(), force, sample.stiffness, n);
            }
        }
        for held in &self.held {
            for (tie, force, stiffness) in held.forces(u) {
                for spread in &held.spreads {
                    visit(spread, tie.direction * force, stiffness, tie.direction);
                }
            }
        }
    }

    /// Sum of the squares of the forces on nodes in N².
    pub(crate) fn square(&self, u: &[Vec3]) -> f64 {
        let mut forces = vec![Vec3::zeros(); self.nodes.len()];
        self.pressed(u, |sample, force, _, _| {
            for (&node, w) in sample.nodes.iter().zip(sample.weights) {
                forces[self.place(node)] += force * w;
            }
        });
        forces.iter().map(Vec3::norm_squared).sum()
    }

    /// Position of a touched node in the list of nodes.
    pub(crate) fn place(&self, node: u32) -> usize {
        self.place[node as usize] as usize
    }

    /// Force on the tool of proxy `i`, with the samples that carry it.
    pub(crate) fn force(&self, u: &[Vec3], i: usize) -> (Vec3, u32) {
        let (mut force, mut count) = (Vec3::zeros(), 0);
        for sample in self.samples.iter().filter(|s| s.proxy == i as u32) {
            let (pressed, n) = self.force_over_stiffness(sample, u);
            if pressed > 0.0 {
                force -= n * (sample.stiffness * pressed);
                count += 1;
            }
        }
        for held in self.held.iter().filter(|h| h.proxy == i as u32) {
            force -= held.force(u);
            count += 1;
        }
        (force, count)
    }
}
