// SPDX-License-Identifier: GPL-2.0
/* A CAN controller for tests: can0 on a bus that takes every frame at once. qemu's controllers know no errors; this one's
 * state is steered by /sys/module/can_sim/parameters/state (0 active, 1 warning, 2 passive, 3 bus-off) and told to the
 * kernel as an interrupt of a real one would be: error frames, carrier, restart-ms and restart are the kernel's own. */
#include <linux/can/dev.h>
#include <linux/can/error.h>
#include <linux/module.h>
#include <linux/netdevice.h>

static struct net_device *controller;

static int state_set(const char *val, const struct kernel_param *kp)
{
	struct can_frame *frame;
	struct sk_buff *skb;
	struct can_priv *priv;
	unsigned int state;
	int err = kstrtouint(val, 10, &state);

	if (err)
		return err;
	if (state > CAN_STATE_BUS_OFF || !controller || !netif_running(controller))
		return -EINVAL;
	priv = netdev_priv(controller);
	if (state == priv->state)
		return 0;
	skb = alloc_can_err_skb(controller, &frame);
	if (!skb)
		return -ENOMEM;
	can_change_state(controller, frame, state, state);
	if (state == CAN_STATE_BUS_OFF)
		can_bus_off(controller);
	netif_rx(skb);
	return 0;
}
static const struct kernel_param_ops state_ops = { .set = state_set };
module_param_cb(state, &state_ops, NULL, 0200);

static int set_mode(struct net_device *dev, enum can_mode mode)
{
	struct can_priv *priv = netdev_priv(dev);

	if (mode != CAN_MODE_START)
		return -EOPNOTSUPP;
	priv->state = CAN_STATE_ERROR_ACTIVE;
	netif_wake_queue(dev);
	return 0;
}

static int open(struct net_device *dev)
{
	struct can_priv *priv = netdev_priv(dev);
	int err = open_candev(dev);

	if (err)
		return err;
	priv->state = CAN_STATE_ERROR_ACTIVE;
	netif_start_queue(dev);
	return 0;
}

static int stop(struct net_device *dev)
{
	struct can_priv *priv = netdev_priv(dev);

	netif_stop_queue(dev);
	priv->state = CAN_STATE_STOPPED;
	close_candev(dev);
	return 0;
}

static netdev_tx_t send(struct sk_buff *skb, struct net_device *dev)
{
	struct can_priv *priv = netdev_priv(dev);

	if (can_dropped_invalid_skb(dev, skb))
		return NETDEV_TX_OK;
	if (priv->state == CAN_STATE_BUS_OFF) {
		kfree_skb(skb);
		dev->stats.tx_dropped++;
		return NETDEV_TX_OK;
	}
	can_put_echo_skb(skb, dev, 0, 0);
	dev->stats.tx_bytes += can_get_echo_skb(dev, 0, NULL);
	dev->stats.tx_packets++;
	return NETDEV_TX_OK;
}

static const struct net_device_ops operations = { .ndo_open = open, .ndo_stop = stop, .ndo_start_xmit = send };
static const struct can_bittiming_const timing = {
	.name = "can_sim",
	.tseg1_min = 1, .tseg1_max = 16, .tseg2_min = 1, .tseg2_max = 8, .sjw_max = 4,
	.brp_min = 1, .brp_max = 64, .brp_inc = 1,
};

static int __init can_sim_init(void)
{
	struct net_device *dev = alloc_candev(sizeof(struct can_priv), 1);
	struct can_priv *priv;
	int err;

	if (!dev)
		return -ENOMEM;
	priv = netdev_priv(dev);
	priv->clock.freq = 16000000;
	priv->bittiming_const = &timing;
	priv->do_set_mode = set_mode;
	dev->netdev_ops = &operations;
	dev->flags |= IFF_ECHO;
	err = register_candev(dev);
	if (err)
		free_candev(dev);
	else
		controller = dev;
	return err;
}

static void __exit can_sim_exit(void)
{
	unregister_candev(controller);
	free_candev(controller);
}

module_init(can_sim_init);
module_exit(can_sim_exit);
MODULE_LICENSE("GPL");
MODULE_DESCRIPTION("Simulated CAN controller");
