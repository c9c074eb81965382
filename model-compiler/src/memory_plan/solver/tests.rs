use super::*;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform enough in `low ..= high`.
    fn range(&mut self, low: u64, high: u64) -> u64 {
        low + self.next() % (high - low + 1)
    }
}

fn rectangle(first: u32, last: u32, bytes: u64) -> Item {
    Item { spans: vec![Span { first, last, bytes }] }
}

/// Height of an item at a step, 0 where it is not live.
fn height(item: &Item, step: u32) -> u64 {
    item.spans.iter().find(|s| (s.first..=s.last).contains(&step)).map_or(0, |s| s.bytes)
}

/// Peak of a packing by looking at every step; panics where two items overlap.
fn checked_peak(items: &[Item], offsets: &[u64]) -> u64 {
    let steps = items.iter().map(|i| i.spans[i.spans.len() - 1].last).max().unwrap_or(0);
    let mut peak = 0;
    for step in 0..=steps {
        let mut ranges: Vec<(u64, u64)> = items
            .iter()
            .zip(offsets)
            .filter(|(i, _)| height(i, step) > 0)
            .map(|(i, &o)| (o, o + height(i, step)))
            .collect();
        ranges.sort_unstable();
        assert!(ranges.windows(2).all(|w| w[0].1 <= w[1].0), "overlap at step {step}: {ranges:?}");
        peak = peak.max(ranges.last().map_or(0, |r| r.1));
    }
    peak
}

/// Least peak over all orders of dropping items onto the pile.
fn brute_force(items: &[Item]) -> u64 {
    fn go(items: &[Item], skyline: &mut Vec<u64>, left: &mut Vec<usize>, best: &mut u64) {
        if left.is_empty() {
            *best = (*best).min(skyline.iter().copied().max().unwrap_or(0));
            return;
        }
        for k in 0..left.len() {
            let id = left.remove(k);
            let saved = skyline.clone();
            let live: Vec<u32> = (0..skyline.len() as u32).filter(|&t| height(&items[id], t) > 0).collect();
            let offset = live.iter().map(|&t| skyline[t as usize]).max().unwrap_or(0);
            live.iter().for_each(|&t| skyline[t as usize] = offset + height(&items[id], t));
            if skyline.iter().all(|s| s < best) {
                go(items, skyline, left, best);
            }
            *skyline = saved;
            left.insert(k, id);
        }
    }
    let mut best = u64::MAX;
    go(items, &mut vec![0; 16], &mut (0..items.len()).collect(), &mut best);
    best
}

/// A few items, some of them shrinking once.
fn small_instance(random: &mut Random) -> Vec<Item> {
    let count = random.range(1, 8).max(random.range(1, 8));
    let (steps, sizes) = (random.range(3, 12).max(random.range(3, 12)) as u32, random.range(2, 6));
    (0..count)
        .map(|_| {
            let first = random.range(0, u64::from(steps) - 1) as u32;
            let last = random.range(u64::from(first), u64::from(steps - 1).min(u64::from(first) + 4)) as u32;
            let bytes = 4 * random.range(1, sizes);
            if last > first && random.range(0, 1) == 0 {
                let split = random.range(u64::from(first), u64::from(last) - 1) as u32;
                let smaller = 4 * random.range(1, bytes / 4);
                return Item {
                    spans: vec![Span { first, last: split, bytes }, Span { first: split + 1, last, bytes: smaller }],
                };
            }
            rectangle(first, last, bytes)
        })
        .collect()
}

#[test]
fn equals_brute_force_on_small_instances() {
    let mut not_reachable = 0;
    for seed in 0..2000 {
        let items = small_instance(&mut Random(seed));
        let packing = pack(&items, 1_000_000);
        let best = brute_force(&items);
        assert_eq!(checked_peak(&items, &packing.offsets), packing.peak, "seed {seed}");
        assert_eq!(packing.peak, best, "seed {seed}: {items:?}");
        let expected = if best == packing.bound {
            PlanStatus::Optimal
        } else {
            not_reachable += 1;
            PlanStatus::OptimalBoundNotReachable
        };
        assert_eq!(packing.status, expected, "seed {seed}");
        exact_search_agrees(&items, best, seed);
    }
    assert!(not_reachable > 5, "only {not_reachable} instances have a gap");
}

/// Without the heuristics: the exact search finds the optimum, and proves that nothing is smaller.
fn exact_search_agrees(items: &[Item], best: u64, seed: u64) {
    let (blocks, sections) = to_sections(items);
    match skyline::search(&blocks, sections, best, u64::MAX, &mut 0) {
        Outcome::Found(offsets) => assert_eq!(checked_peak(items, &offsets), best, "seed {seed}"),
        _ => panic!("seed {seed}: {best} not found"),
    }
    let below = skyline::search(&blocks, sections, best - 4, u64::MAX, &mut 0);
    assert!(matches!(below, Outcome::Exhausted), "seed {seed}: found less than {best}");
}

/// Cuts a rectangle of time × memory into at least `count` pieces: no slack anywhere.
fn perfect_instance(random: &mut Random, count: usize, steps: u32, height: u64, unit: u64) -> Vec<Item> {
    let mut pieces = vec![(0_u32, steps - 1, height / unit)];
    while pieces.len() < count {
        // The larger of three: pieces of all sizes, none left huge.
        let pick = (0..3)
            .map(|_| random.range(0, pieces.len() as u64 - 1) as usize)
            .max_by_key(|&i| u64::from(pieces[i].1 - pieces[i].0 + 1) * pieces[i].2)
            .unwrap_or(0);
        let (first, last, bytes) = pieces[pick];
        if random.range(0, 1) == 0 && last > first {
            let cut = random.range(u64::from(first), u64::from(last) - 1) as u32;
            pieces[pick] = (first, cut, bytes);
            pieces.push((cut + 1, last, bytes));
        } else if bytes > 1 {
            let cut = random.range(1, bytes - 1);
            pieces[pick] = (first, last, cut);
            pieces.push((first, last, bytes - cut));
        }
    }
    for i in (1..pieces.len()).rev() {
        pieces.swap(i, random.range(0, i as u64) as usize);
    }
    pieces.into_iter().map(|(first, last, bytes)| rectangle(first, last, bytes * unit)).collect()
}

/// Every packing must have the height of the rectangle that it was cut from.
fn fills_rectangles(steps: u32, height: u64) {
    for seed in 0..11 {
        let items = perfect_instance(&mut Random(seed), 200 + 10 * seed as usize, steps, height, 16);
        let packing = pack(&items, 2_000_000);
        let found = (packing.peak, packing.bound, packing.status);
        println!("seed {seed}: {} items, {found:?}, {} nodes", items.len(), packing.nodes);
        assert_eq!(found, (height, height, PlanStatus::Optimal), "seed {seed}");
        assert_eq!(checked_peak(&items, &packing.offsets), height, "seed {seed}");
    }
}

#[test]
fn fills_rectangles_without_slack() {
    fills_rectangles(400, 1 << 20);
}

#[test]
fn fills_rectangles_of_few_distinct_sizes_without_slack() {
    fills_rectangles(400, 4096);
}

#[test]
fn node_limit_is_kept_and_the_gap_told() {
    for seed in 0..20 {
        let items = perfect_instance(&mut Random(seed), 120, 20, 1 << 20, 4);
        let packing = pack(&items, 2_000);
        assert!(packing.nodes < 2_000 + 2 * items.len() as u64, "seed {seed}: {}", packing.nodes);
        assert_eq!(checked_peak(&items, &packing.offsets), packing.peak, "seed {seed}");
        assert_eq!(packing.status == PlanStatus::Optimal, packing.peak == packing.bound, "seed {seed}");
    }
}

#[test]
fn an_empty_problem_has_an_empty_packing() {
    let packing = pack(&[], 10);
    assert_eq!((packing.peak, packing.bound, packing.status), (0, 0, PlanStatus::Optimal));
}
