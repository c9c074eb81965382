//! How deep the stack of a function can become: the sum of frames along the deepest chain of calls.
//!
//! A frame's size is the compiler's own note (`-Z emit-stack-sizes`), or for assembly the sum of what it pushes. The
//! bound holds for every input, but says nothing about interrupts, which add their own. It is *not shown* where
//! control goes through a register, where a function calls itself, and where a frame's size is not known.

use super::calls::Calls;
use super::elf::{Elf, Function, InstructionSet};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Bound of a function's stack.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Bound {
    /// The function.
    pub root: String,
    /// Functions that it reaches, itself included.
    pub functions: usize,
    /// Bytes of stack from its entry on; missing where no bound is shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bytes: Option<u64>,
    /// The deepest chain of calls, with each frame; empty where no bound is shown.
    pub deepest: Vec<Frame>,
    /// Why no bound is shown; empty where one is.
    pub obstacles: Vec<Obstacle>,
}

/// A frame of the deepest chain.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct Frame {
    /// The function.
    pub function: String,
    /// Its frame, bytes.
    pub bytes: u64,
}

/// What stands in the way of a bound.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Obstacle {
    /// Control goes through a register.
    IndirectCalls {
        /// Where.
        function: String,
        /// How often in its code.
        count: usize,
    },
    /// A chain of calls comes back to this function.
    Recursion {
        /// The function.
        function: String,
    },
    /// The size of its frame is not known: it was compiled without `-Z emit-stack-sizes`.
    UnknownFrame {
        /// The function.
        function: String,
    },
    /// A call to where no function begins.
    UnknownTarget {
        /// The caller.
        function: String,
        /// The address called.
        address: u64,
    },
}

/// Who calls whom in a program.
pub(super) struct CallGraph<'e> {
    nodes: BTreeMap<u64, Node<'e>>,
}

struct Node<'e> {
    function: &'e Function<'e>,
    calls: Calls,
    frame: Option<u64>,
}

impl<'e> CallGraph<'e> {
    pub fn of(elf: &'e Elf<'e>) -> Self {
        let node = |function: &'e Function<'e>| {
            let calls = Calls::of(function, elf.instruction_set);
            let frame = function.frame.or_else(|| pushed(function, elf.instruction_set));
            (function.address, Node { function, calls, frame })
        };
        Self { nodes: elf.functions.iter().map(node).collect() }
    }

    /// The bound for the function whose path is `root` or ends with `::root`, of several the deepest; `None` where there
    /// is no such function.
    pub fn bound(&self, root: &str) -> Option<Bound> {
        let is_root = |name: &str| name.strip_suffix(root).is_some_and(|path| path.is_empty() || path.ends_with("::"));
        let roots = self.nodes.values().filter(|node| is_root(without_generics(&node.function.name)));
        roots.map(|node| self.bound_of(node)).max_by_key(|bound| bound.bytes.unwrap_or(u64::MAX))
    }

    fn bound_of(&self, root: &Node<'_>) -> Bound {
        let mut walk = Walk { graph: self, depths: BTreeMap::new(), open: BTreeSet::new(), obstacles: BTreeSet::new() };
        let bytes = walk.depth(root);
        let shown = walk.obstacles.is_empty();
        Bound {
            root: root.function.name.clone(),
            functions: walk.depths.len(),
            bytes: shown.then_some(bytes),
            deepest: if shown { walk.deepest(root) } else { Vec::new() },
            obstacles: walk.obstacles.into_iter().collect(),
        }
    }
}

/// A walk from one function over all that it reaches.
struct Walk<'g> {
    graph: &'g CallGraph<'g>,
    /// Depths of the functions that are done.
    depths: BTreeMap<u64, u64>,
    /// The chain under way.
    open: BTreeSet<u64>,
    obstacles: BTreeSet<Obstacle>,
}

impl Walk<'_> {
    /// Bytes from the entry of a function on, as far as they are known.
    fn depth(&mut self, node: &Node<'_>) -> u64 {
        let (address, name) = (node.function.address, &node.function.name);
        if let Some(depth) = self.depths.get(&address) {
            return *depth;
        }
        if !self.open.insert(address) {
            self.obstacles.insert(Obstacle::Recursion { function: name.clone() });
            return 0;
        }
        if node.calls.indirect > 0 {
            self.obstacles.insert(Obstacle::IndirectCalls { function: name.clone(), count: node.calls.indirect });
        }
        if node.frame.is_none() {
            self.obstacles.insert(Obstacle::UnknownFrame { function: name.clone() });
        }
        let mut below = 0;
        for target in &node.calls.targets {
            match self.graph.nodes.get(target) {
                Some(callee) => below = below.max(self.depth(callee)),
                None => {
                    self.obstacles.insert(Obstacle::UnknownTarget { function: name.clone(), address: *target });
                }
            }
        }
        self.open.remove(&address);
        let depth = node.frame.unwrap_or(0) + below;
        self.depths.insert(address, depth);
        depth
    }

    /// The chain that gives the depth.
    fn deepest(&self, root: &Node<'_>) -> Vec<Frame> {
        let frame = |node: &Node<'_>| Frame { function: node.function.name.clone(), bytes: node.frame.unwrap_or(0) };
        let mut chain = vec![frame(root)];
        let mut targets = &root.calls.targets;
        while let Some(next) = targets.iter().max_by_key(|target| self.depths.get(target)) {
            let Some(node) = self.graph.nodes.get(next) else { break };
            chain.push(frame(node));
            targets = &node.calls.targets;
        }
        chain
    }
}

/// `a::b` of `a::b::<c>` and of `a::b<c>`.
fn without_generics(name: &str) -> &str {
    let path = name.strip_suffix('>').and_then(|name| Some(&name[..name.rfind("::<").or_else(|| name.find('<'))?]));
    path.filter(|path| !path.is_empty()).unwrap_or(name)
}

/// What a function in assembly pushes, in any order; `None` where it moves the stack pointer otherwise, or is no such
/// function that is known here.
fn pushed(function: &Function<'_>, set: InstructionSet) -> Option<u64> {
    if set != InstructionSet::Thumb {
        return None;
    }
    let mut words = function.code.as_chunks::<2>().0.iter().map(|bytes| u16::from_le_bytes(*bytes));
    let mut bytes = 0;
    while let Some(first) = words.next() {
        let second = if first >> 11 >= 0b11101 { words.next()? } else { 0 };
        bytes += match first {
            // PUSH; SUB SP.
            0xB400..=0xB5FF => 4 * u64::from((first & 0x1FF).count_ones()),
            0xB080..=0xB0FF => 4 * u64::from(first & 0x7F),
            // PUSH.W, and STR to a stack pointer moved before.
            0xE92D => 4 * u64::from(second.count_ones()),
            0xF84D if second & 0x0FFF == 0x0D04 => 4,
            // VPUSH; SUB.W SP; MOV to SP.
            0xED2D | 0xED6D | 0xF1AD | 0xF5AD | 0xF2AD => return None,
            _ if first & 0xFF87 == 0x4685 => return None,
            _ => 0,
        };
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn function(name: &str, address: u64, code: &'static [u8], frame: Option<u64>) -> Function<'static> {
        Function { name: name.into(), address, code, data: Vec::new(), frame }
    }

    fn elf(functions: Vec<Function<'static>>) -> Elf<'static> {
        Elf { file: "t".into(), instruction_set: InstructionSet::A64, sections: Vec::new(), functions }
    }

    const RET: [u8; 4] = 0xD65F_03C0_u32.to_le_bytes();
    /// `bl .+8; bl .+12`: calls of the next two functions of 8 bytes.
    const TWO_CALLS: [u8; 8] = [0x02, 0, 0, 0x94, 0x03, 0, 0, 0x94];

    #[test]
    fn the_deepest_chain_counts() {
        let elf = elf(vec![
            function("t::root", 0, &TWO_CALLS, Some(16)),
            // `b .+8`: a tail call.
            function("t::shallow", 8, &[0x02, 0, 0, 0x14, 0, 0, 0, 0], Some(8)),
            function("t::deep", 16, &RET, Some(100)),
        ]);
        let bound = CallGraph::of(&elf).bound("root").unwrap();
        assert_eq!((bound.bytes, bound.functions), (Some(124), 3));
        let chain: Vec<&str> = bound.deepest.iter().map(|frame| frame.function.as_str()).collect();
        assert_eq!(chain, ["t::root", "t::shallow", "t::deep"]);
        assert_eq!(CallGraph::of(&elf).bound("oot"), None, "half a name is none");
    }

    #[test]
    fn what_cannot_be_bounded_is_not_shown() {
        // `bl .-8`: back to the root; `blr x8`; a call to nowhere.
        let elf = elf(vec![
            function("t::root", 0, &TWO_CALLS, Some(16)),
            function("t::again", 8, &[0xFE, 0xFF, 0xFF, 0x97, 0x00, 0x01, 0x3F, 0xD6], Some(8)),
            function("t::unknown", 16, &[0x40, 0, 0, 0x94], None),
        ]);
        let bound = CallGraph::of(&elf).bound("t::root").unwrap();
        assert_eq!(bound.bytes, None);
        let name = |name: &str| name.to_owned();
        assert_eq!(
            bound.obstacles,
            [
                Obstacle::IndirectCalls { function: name("t::again"), count: 1 },
                Obstacle::Recursion { function: name("t::root") },
                Obstacle::UnknownFrame { function: name("t::unknown") },
                Obstacle::UnknownTarget { function: name("t::unknown"), address: 0x110 },
            ]
        );
    }

    #[test]
    fn assembly_takes_what_it_pushes() {
        // push {r4, lr}; sub sp, #16; push.w {r8, r9}; bx lr
        let code = &[0x10, 0xB5, 0x84, 0xB0, 0x2D, 0xE9, 0x00, 0x03, 0x70, 0x47];
        assert_eq!(pushed(&function("f", 0, code, None), InstructionSet::Thumb), Some(32));
        // mov sp, r7
        assert_eq!(pushed(&function("f", 0, &[0xBD, 0x46], None), InstructionSet::Thumb), None);
    }

    #[test]
    fn generics_are_no_part_of_a_path() {
        for name in ["a::step::<b::C>", "a::step<b::C>", "a::step", "a::step::<b::C<d::E>>"] {
            assert_eq!(without_generics(name), "a::step", "{name}");
        }
        assert_eq!(without_generics("<a::B as c::D>::e"), "<a::B as c::D>::e");
    }
}
