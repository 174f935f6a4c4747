# Run by systemd in a namespace of its own: kernels, an emulated camera, the installed unit, a flight.
# Each line of its output is a fact that test_flight.py reads.
fact() {
    echo "$1=$2"
}
# The unit that asks disks, hardened as installed; its timer starts it without anybody's help.
systemctl start syntopic-disk-health.service
fact health_started $?
fact health_result "$(systemctl show -P Result syntopic-disk-health.service)"
health=/run/syntopic-health
fact health_file "$(stat -c '%U %a' $health/disks.json)"
fact health_folder "$(stat -c '%U %a' $health)"
fact health_read "$(setpriv --reuid syntopic --regid syntopic --clear-groups grep -c N0001 $health/disks.json)"
setpriv --reuid syntopic --regid syntopic --clear-groups touch $health/planted 2>/dev/null
fact health_planted $?
rm $health/disks.json
systemctl start syntopic-disk-health.timer
for second in $(seq 60); do
    [ -s $health/disks.json ] && break
    sleep 1
done
fact health_by_timer "$(grep -c N0001 $health/disks.json)"
systemctl start kernels.service
fact kernels $?
systemctl start sim.service
sim=/var/lib/syntopic/sim
for second in $(seq 300); do
    [ -s $sim/service.toml ] && break
    sleep 1
done
sed -i 's/^\[trigger\]/[trigger]\ncount = 4/; s/^end_when_done.*/end_when_done = true/' $sim/service.toml
# Type=notify: this returns when the service reported that it is ready.
systemctl start syntopic.service
fact started $?
pid=$(systemctl show -P MainPID syntopic.service)
fact user "$(ps -o user= -p "$pid")"
# The confinement as the kernel reports it: no new privileges, filtered system calls, capabilities.
for word in NoNewPrivs Seccomp CapEff; do
    fact $word "$(sed -n "s/^$word:[[:space:]]*//p" "/proc/$pid/status")"
done
fact oom_policy "$(systemctl show -P OOMPolicy syntopic.service)"
# The page's process is the one that the kernel would end first; the flight goes on without it.
page=$(grep -lx 900 /proc/[0-9]*/oom_score_adj | cut -d/ -f3)
fact page_user "$(ps -o user= -p "$page")"
kill -9 "$page"
fact page_killed $?
for second in $(seq 300); do
    systemctl is-active -q syntopic.service || break
    sleep 1
done
fact result "$(systemctl show -P Result syntopic.service)"
fact status "$(systemctl show -P ExecMainStatus syntopic.service)"
fact sealed "$(find $sim/missions -name exposure.json | wc -l)"
fact processed "$(find $sim/missions -name quality.json | wc -l)"
/opt/syntopic/bin/syntopic verify $sim/missions/2*
fact verified $?
