//! Against all assignments of small random models.

use super::*;
use crate::memory_plan::Needs;

/// Xorshift.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % n
    }
}

/// Six steps that read what earlier ones wrote; sizes and traffic at random.
fn needs(seed: u64) -> Needs {
    let mut random = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let steps = 6;
    let bytes: Vec<u64> = (0..=steps).map(|_| 16 * (1 + random.below(6))).collect();
    let mut reads: Vec<Vec<usize>> = Vec::new();
    for step in 0..steps {
        let mut read = vec![step, random.below(step as u64 + 1) as usize];
        read.sort_unstable();
        read.dedup();
        reads.push(read);
    }
    let takes = |step: usize, t: &usize| bytes[*t] >= bytes[step + 1];
    let overwritable = (0..steps).map(|s| reads[s].iter().copied().filter(|t| takes(s, t)).take(1).collect()).collect();
    let scratch: Vec<u64> = (0..steps).map(|_| 16 * random.below(3)).collect();
    Needs {
        exact_bytes: bytes.clone(),
        is_output: (0..=steps).map(|t| t == steps).collect(),
        is_input: (0..=steps).map(|t| t == 0).collect(),
        writes: (1..=steps).collect(),
        kernels: vec![None; steps],
        tensor_traffic: bytes.iter().map(|bytes| bytes * (2 + random.below(8))).collect(),
        scratch_traffic: scratch.iter().map(|bytes| bytes * (20 + random.below(40))).collect(),
        tensor_bytes: bytes,
        overwritable,
        reads,
        scratch,
        alignment: 16,
    }
}

/// Traffic per region of the best assignment of all, if one fits.
fn best_of_all(job: &Job<'_>, all: &Pairs, budgets: &[u64]) -> Option<Vec<u64>> {
    let apart: Pairs = vec![None; all.len()];
    let count = items(job, &apart).shapes.len() as u32;
    let assignments = (0..(budgets.len() as u64).pow(count)).filter_map(|code| {
        let items = items(job, &apart);
        let digit = |item: u32| (code / (budgets.len() as u64).pow(item) % budgets.len() as u64) as usize;
        let region_of: Vec<usize> = (0..count).map(digit).collect();
        let mut traffic = vec![0; budgets.len()];
        let of_items = items.traffic(job.needs, job.order);
        region_of.iter().zip(of_items).for_each(|(&region, bytes)| traffic[region] += bytes);
        let choice = Choice { pairs: apart.clone(), items, region_of, overflow: 0, traffic };
        let joined = joined(job, all, choice, budgets);
        (joined.overflow == 0).then_some(joined.traffic)
    });
    assignments.max()
}

#[test]
fn close_to_the_best_of_all_assignments() {
    let (mut fitting, mut found, mut equal) = (0, 0, 0);
    let (mut most, mut reached) = (0, 0);
    for seed in 0..120 {
        let needs = needs(seed);
        let order: Vec<usize> = (0..needs.writes.len()).collect();
        let ranges = needs.live_ranges(&order);
        let all = needs.pairs(&order, &ranges);
        let job = Job { needs: &needs, order: &order, ranges: &ranges, node_limit: 10_000 };
        // The second region is at times too small for what the first cannot hold, at times more than enough.
        let budgets = [64 + 16 * (seed % 5), 96 + 16 * (seed % 13)];
        let choice = choose(&job, &all, &budgets);
        let Some(best) = best_of_all(&job, &all, &budgets) else {
            assert!(choice.overflow > 0, "seed {seed}: nothing fits");
            continue;
        };
        fitting += 1;
        if choice.overflow > 0 {
            println!("seed {seed}: not found");
            continue;
        }
        let layout = spread(&job, &all, &budgets.map(Some));
        let packed = layout.packings.iter().zip(budgets).all(|(packing, budget)| packing.peak <= budget);
        assert!(packed, "seed {seed}: {:?}", layout.packings);
        assert!(choice.traffic <= best, "seed {seed}: {:?}, best of all {best:?}", choice.traffic);
        found += 1;
        equal += u32::from(choice.traffic == best);
        (most, reached) = (most + best[0], reached + choice.traffic[0]);
    }
    let share = 100.0 * reached as f64 / most as f64;
    println!("{fitting} of 120 fit; {found} found, {equal} of them the best; {share:.2} % of the best traffic");
    assert!(fitting > 60 && 100 * found >= 97 * fitting, "{found} of {fitting} that fit");
    assert!(share > 97.0, "{share} % of the best traffic in the first region");
}

#[test]
fn everything_goes_into_the_first_region_that_is_large_enough() {
    let needs = needs(3);
    let order: Vec<usize> = (0..needs.writes.len()).collect();
    let ranges = needs.live_ranges(&order);
    let all = needs.pairs(&order, &ranges);
    let job = Job { needs: &needs, order: &order, ranges: &ranges, node_limit: 10_000 };
    for capacities in [[None, Some(16)], [Some(4096), None]] {
        let layout = spread(&job, &all, &capacities);
        assert!(layout.region_of.iter().all(|&region| region == 0));
        assert_eq!(layout.packings[1].peak, 0);
        assert_eq!(layout.pairs, all, "pairs are kept");
    }
    let layout = spread(&job, &all, &[Some(0), Some(4096)]);
    assert!(layout.region_of.iter().all(|&region| region == 1));
}

#[test]
fn what_fits_nowhere_overfills_the_last_region() {
    let needs = needs(4);
    let order: Vec<usize> = (0..needs.writes.len()).collect();
    let ranges = needs.live_ranges(&order);
    let all = needs.pairs(&order, &ranges);
    let job = Job { needs: &needs, order: &order, ranges: &ranges, node_limit: 10_000 };
    let layout = spread(&job, &all, &[Some(16), Some(16)]);
    assert!(layout.packings[0].peak <= 16 && layout.packings[1].peak > 16);
}
