// SPDX-License-Identifier: GPL-2.0
/* A PPS source for tests: one assert event per second of CLOCK_REALTIME, or, with raw=1, of CLOCK_MONOTONIC_RAW, which
 * nobody steps or slews; the stamps are CLOCK_REALTIME's either way. Steered by parameters
 * in /sys/module/pps_sim/parameters: offset_ns (after the second), jitter_ns (uniform, +-), on (0: no pulses),
 * drop (swallow the next N pulses), extra (1: one stray pulse now). */
#include <linux/hrtimer.h>
#include <linux/module.h>
#include <linux/pps_kernel.h>
#include <linux/random.h>

static long offset_ns; module_param(offset_ns, long, 0644);
static uint jitter_ns; module_param(jitter_ns, uint, 0644);
static bool on = true; module_param(on, bool, 0644);
static uint drop;      module_param(drop, uint, 0644);
static bool raw;       module_param(raw, bool, 0444);

static struct pps_device *pps;
static struct hrtimer timer;
static u64 due_raw;

static void pulse(void)
{
	struct pps_event_time ts;

	pps_get_ts(&ts);
	pps_event(pps, &ts, PPS_CAPTUREASSERT, NULL);
}

static int extra_set(const char *val, const struct kernel_param *kp)
{
	if (pps)
		pulse();
	return 0;
}
static const struct kernel_param_ops extra_ops = { .set = extra_set };
module_param_cb(extra, &extra_ops, NULL, 0200);

static ktime_t next_pulse(void)
{
	u64 now = ktime_get_real_ns() + NSEC_PER_SEC / 4;
	u64 t = (div_u64(now - offset_ns, NSEC_PER_SEC) + 1) * NSEC_PER_SEC + offset_ns;

	if (jitter_ns)
		t += (s64)prandom_u32_max(2 * jitter_ns) - jitter_ns;
	return ns_to_ktime(t);
}

/* A timer runs on a clock that is slewed: it is set a little too early, until next to nothing is left. */
static ktime_t towards(s64 left)
{
	return ns_to_ktime(ktime_get_ns() + left - (left >> 10));
}

static enum hrtimer_restart tick(struct hrtimer *t)
{
	s64 left = raw ? (s64)(due_raw - ktime_get_raw_ns()) : 0;

	if (left > 5000) {
		hrtimer_set_expires(t, towards(left));
		return HRTIMER_RESTART;
	}
	if (drop)
		drop--;
	else if (on)
		pulse();
	due_raw += NSEC_PER_SEC;
	hrtimer_set_expires(t, raw ? towards(due_raw - ktime_get_raw_ns()) : next_pulse());
	return HRTIMER_RESTART;
}

static struct pps_source_info info = {
	.name = "sim",
	.mode = PPS_CAPTUREASSERT | PPS_OFFSETASSERT | PPS_CANWAIT | PPS_TSFMT_TSPEC,
	.owner = THIS_MODULE,
};

static int __init pps_sim_init(void)
{
	pps = pps_register_source(&info, PPS_CAPTUREASSERT | PPS_OFFSETASSERT);
	if (IS_ERR(pps))
		return PTR_ERR(pps);
	hrtimer_init(&timer, raw ? CLOCK_MONOTONIC : CLOCK_REALTIME, HRTIMER_MODE_ABS_HARD);
	timer.function = tick;
	due_raw = (div_u64(ktime_get_raw_ns(), NSEC_PER_SEC) + 1) * NSEC_PER_SEC;
	hrtimer_start(&timer, raw ? towards(due_raw - ktime_get_raw_ns()) : next_pulse(), HRTIMER_MODE_ABS_HARD);
	return 0;
}

static void __exit pps_sim_exit(void)
{
	hrtimer_cancel(&timer);
	pps_unregister_source(pps);
}

module_init(pps_sim_init);
module_exit(pps_sim_exit);
MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("Simulated pulse per second");
